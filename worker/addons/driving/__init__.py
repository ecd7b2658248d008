"""Driving by hand, on the track or in the dream."""

__all__ = ["verb", "picture_window"]
