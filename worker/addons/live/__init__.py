"""Drives and dreams in a window while they happen."""

__all__ = ["verb"]
