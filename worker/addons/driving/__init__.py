"""Driving by hand, on the track or in the dream.

Its pages: docs/tutorials/first-drive.md, docs/reference/tasks.md.
"""

__all__ = ["verb", "picture_window"]
