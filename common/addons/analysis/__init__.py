"""What runs and their curves have in common: charts, comparison, learning, archives of elites.

Pages: export.md, files.md, quality-diversity.md.
"""

__all__ = ["scored_history", "comparison", "run_archive", "fitness_chart", "learning"]
