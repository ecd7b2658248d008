"""Controllers, world models and drives of other projects, read as data and never executed."""

__all__ = ["verb"]
