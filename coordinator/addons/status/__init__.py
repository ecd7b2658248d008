"""A run's status on a terminal. Pages: status.md, watch.md, fleet.md."""

__all__ = ["verb", "status_panel"]
