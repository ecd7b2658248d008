"""Experiments, above both sides: several runs in sequence or side by side, and one run of your program."""

__all__ = ["minimise", "started_run", "controllers", "pipeline", "demo", "rerun"]
