"""The coordinator on Zenoh: name lock, inbound queue, status, metrics.

Its pages: docs/reference/protocol.md, docs/reference/status.md, docs/how-to/stop-and-resume.md.
"""

__all__ = ["main", "snapshot"]
