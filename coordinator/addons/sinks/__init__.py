"""A run's numbers sent to other programs while it goes on."""

__all__ = ["live_log", "sinks"]
