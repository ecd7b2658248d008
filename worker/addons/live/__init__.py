"""Drives and dreams in a window while they happen.

Its pages: docs/how-to/watch.md.
"""

__all__ = ["verb"]
