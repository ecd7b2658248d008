"""The coordinator on Zenoh: name lock, inbound queue, status, control verbs, the log.

Pages: protocol.md, status.md, stop-and-resume.md.
"""

__all__ = ["main", "snapshot"]
