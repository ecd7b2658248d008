"""Scoring candidates, with one episode loop for scoring, evaluating, recording and collecting."""

__all__ = ["scorer", "episode", "rollout", "actors", "disturbance", "drive_count", "failure_cause", "host_class_probe"]
