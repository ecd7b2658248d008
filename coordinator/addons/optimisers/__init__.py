"""Optimisers beside CMA-ES.

Its pages: docs/reference/optimisers.md.
"""

__all__ = ["cmaes_library", "search_gradients"]
