"""Optimisers beside CMA-ES."""
