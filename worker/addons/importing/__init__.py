"""Controllers, world models and drives of other projects, read as data and never executed. Pages: import.md."""

__all__ = ["verb"]
