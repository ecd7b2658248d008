"""The worlds that ship: presets of their runs and trainings, published scores, demonstrations.

Pages: worlds.md, tasks.md, presets.md.
"""

__all__ = ["car_racing", "takecover"]
