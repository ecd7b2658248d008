"""Asking live runs from any host: status, and what follows from it.

Its pages: docs/reference/status.md, docs/reference/python.md, docs/how-to/watch.md, docs/tutorials/fleet.md.
"""

__all__ = ["client", "status", "run_view", "eta", "equal_fitness", "elite_archive"]
