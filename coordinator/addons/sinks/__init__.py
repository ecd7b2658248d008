"""A run's numbers sent to other programs while it goes on.

Its pages: docs/how-to/monitor.md, docs/reference/python.md.
"""

__all__ = ["live_log", "sinks"]
