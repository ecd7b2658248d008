"""A run's status on a terminal."""

__all__ = ["verb", "status_panel"]
