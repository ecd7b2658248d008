"""Driving by hand, on the track or in the dream, and the window of `live`. Pages: first-drive.md, tasks.md."""

__all__ = ["verb", "picture_window"]
