"""Agents by name, and their scores on unseen episodes."""

__all__ = ["verb", "evaluation", "named_agents", "predictor", "agents", "evaluation_report", "known_score"]
