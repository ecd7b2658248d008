"""The coordinator on Zenoh: name lock, inbound queue, status, metrics."""

__all__ = ["main", "snapshot"]
