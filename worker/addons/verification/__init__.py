"""Scores driven again: a candidate of a run, a report."""

__all__ = ["candidate_verb", "report_verb"]
