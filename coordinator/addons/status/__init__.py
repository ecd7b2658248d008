"""A run's status on a terminal.

Its pages: docs/reference/status.md, docs/how-to/watch.md, docs/tutorials/fleet.md.
"""

__all__ = ["verb", "status_panel"]
