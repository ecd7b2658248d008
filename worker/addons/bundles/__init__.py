"""Bundles taken apart, or rounded to eight bits."""

__all__ = ["verb", "extract", "weights_from_graphs"]
