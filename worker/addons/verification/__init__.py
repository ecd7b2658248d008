"""Scores driven again: a candidate of a run, a report."""
