"""Scores driven again: a candidate of a run, a report. Pages: determinism.md, files.md, results.md."""

__all__ = ["candidate_verb", "report_verb"]
