"""A run's numbers sent to other programs while it goes on. Pages: monitor.md, python.md."""

__all__ = ["live_log", "sinks"]
