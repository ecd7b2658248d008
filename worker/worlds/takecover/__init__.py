"""ViZDoom's Take Cover: a player who can only step aside lives as long as no fireball hits.

docs/reference/tasks.md describes what people see of it.
"""

__all__ = ["task"]
