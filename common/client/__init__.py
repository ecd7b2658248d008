"""Asking live runs from any host: status, what follows, elites. Pages: status.md, python.md, watch.md, fleet.md."""

__all__ = ["client", "status", "run_view", "eta", "equal_fitness", "elite_archive"]
