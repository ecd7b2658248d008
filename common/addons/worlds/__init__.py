"""The worlds that ship: presets of their runs and trainings, published scores, demonstrations."""

__all__ = ["car_racing", "takecover"]
