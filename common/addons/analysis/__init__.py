"""What runs and their curves have in common: charts, comparison, learning."""

__all__ = ["comparison", "elites", "fitness_chart", "learning"]
