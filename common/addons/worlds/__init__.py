"""The worlds that ship: presets of their runs and trainings, published scores, demonstrations.

Its pages: docs/reference/worlds.md, docs/reference/tasks.md, docs/reference/presets.md.
"""

__all__ = ["car_racing", "takecover"]
