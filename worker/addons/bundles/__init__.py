"""Bundles taken apart, or rounded to eight bits. Pages: worlds.md, import.md."""

__all__ = ["verb", "extract", "weights_from_graphs"]
