"""Optimisers beside CMA-ES."""

__all__ = ["cmaes_library", "search_gradients"]
