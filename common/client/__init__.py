"""Asking live runs from any host: status, and what follows from it."""

__all__ = ["client", "status", "run_view", "eta", "equal_fitness", "elites"]
