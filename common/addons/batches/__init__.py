"""Candidates of your own, scored by a fleet."""
