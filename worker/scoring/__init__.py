"""Scoring candidates, with one episode loop for scoring, evaluating, recording and collecting.

Also here: host classes, causes of failures, disturbed drives. Pages: determinism.md, protocol.md, mixed-hosts.md.
"""

__all__ = ["scorer", "episode", "rollout", "actors", "disturbance", "drive_count", "failure_cause", "host_class_probe"]
