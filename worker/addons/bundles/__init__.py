"""Bundles taken apart, or rounded to eight bits.

Its pages: docs/reference/worlds.md, docs/reference/import.md.
"""

__all__ = ["verb", "extract", "weights_from_graphs"]
