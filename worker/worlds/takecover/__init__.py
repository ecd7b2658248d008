"""ViZDoom's Take Cover: a player who can only step aside lives as long as no fireball hits.

Its pages: docs/reference/tasks.md, docs/lab/takecover.md.
"""

__all__ = ["task"]
