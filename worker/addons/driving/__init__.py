"""Driving by hand, on the track or in the dream."""
