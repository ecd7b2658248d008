"""Scoring candidates, with one episode loop for scoring, evaluating, recording and collecting.

Its pages: docs/explanation/determinism.md, docs/reference/protocol.md, docs/how-to/mixed-hosts.md.
"""

__all__ = ["scorer", "episode", "rollout", "actors", "disturbance", "drive_count", "failure_cause", "host_class_probe"]
