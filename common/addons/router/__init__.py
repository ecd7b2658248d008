"""A Zenoh router between hosts that do not reach each other."""

__all__ = ["verb"]
