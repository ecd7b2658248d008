"""Experiments, above both sides: several runs in sequence or side by side, and one run of your program.

Its pages: docs/reference/python.md, docs/how-to/sweep.md, docs/how-to/rounds.md, docs/how-to/train.md.
"""

__all__ = ["minimise", "started_run", "controllers", "pipeline", "demo", "rerun"]
