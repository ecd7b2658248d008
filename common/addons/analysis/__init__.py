"""What runs and their curves have in common: charts, comparison, learning, archives of elites.

Its pages: docs/how-to/export.md, docs/reference/files.md, docs/how-to/quality-diversity.md.
"""

__all__ = ["scored_history", "comparison", "run_archive", "fitness_chart", "learning"]
