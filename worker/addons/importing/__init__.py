"""Controllers, world models and drives of other projects, read as data and never executed.

Its pages: docs/reference/import.md.
"""

__all__ = ["verb"]
