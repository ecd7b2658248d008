"""Optimisers beside CMA-ES. Pages: optimisers.md."""

__all__ = ["cmaes_library", "search_gradients"]
