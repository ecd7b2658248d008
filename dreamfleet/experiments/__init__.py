"""Experiments, above both sides: several runs in sequence or side by side, and one run of your program.

`minimise` searches a function, `started_run` evolves, `controllers` evaluates.
Pages: python.md, sweep.md, rounds.md, train.md.
"""

__all__ = ["minimise", "started_run", "controllers", "pipeline", "demo", "rerun"]
