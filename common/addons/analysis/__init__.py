"""What runs and their curves have in common: charts, comparison, learning."""

__all__ = ["scored_history", "comparison", "elites", "fitness_chart", "learning"]
