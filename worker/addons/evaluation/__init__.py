"""Agents by name, and their scores on unseen episodes.

Its pages: docs/lab/results.md, docs/how-to/export.md, docs/reference/files.md.
"""

__all__ = ["verb", "evaluation", "named_agents", "predictor", "agents", "evaluation_report", "known_score"]
