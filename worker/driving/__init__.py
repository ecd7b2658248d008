"""A person at the wheel, on the track or in the dream."""
