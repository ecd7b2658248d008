"""Scores driven again: a candidate of a run, a report.

Its pages: docs/explanation/determinism.md, docs/reference/files.md.
"""

__all__ = ["candidate_verb", "report_verb"]
