"""Candidates of your own, scored by a fleet."""

__all__ = ["remote_scorer", "batch_client"]
