"""Agents by name, and their scores on unseen episodes. Pages: results.md, export.md, files.md."""

__all__ = ["verb", "evaluation", "named_agents", "predictor", "agents", "known_score"]
