"""Driving by hand, on the track or in the dream. Pages: first-drive.md, tasks.md."""

__all__ = ["verb", "picture_window"]
