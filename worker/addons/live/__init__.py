"""Drives and dreams in a window while they happen. Pages: watch.md."""

__all__ = ["verb"]
