"""Candidates of your own, scored by a fleet. Pages: ask-tell.md, python.md."""

__all__ = ["remote_scorer", "batch_client"]
