"""A Zenoh router between hosts that do not reach each other. Pages: router.md, security.md."""

__all__ = ["verb"]
