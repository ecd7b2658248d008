"""Bundles taken apart, or rounded to eight bits; assemble.py makes them. Pages: worlds.md, import.md, train.md."""

__all__ = ["verb", "extract", "weights_from_graphs"]
