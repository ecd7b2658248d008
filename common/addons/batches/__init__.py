"""Candidates of your own, scored by a fleet.

Its pages: docs/how-to/ask-tell.md, docs/reference/python.md.
"""

__all__ = ["remote_scorer", "batch_client"]
