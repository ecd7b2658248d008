"""Runs on disk: their journals as typed records, schedules, provenance and evaluation reports."""
