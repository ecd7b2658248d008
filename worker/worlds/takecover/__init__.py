"""ViZDoom's Take Cover: a player who can only step aside lives as long as no fireball hits.

Pages: tasks.md, takecover.md.
"""

__all__ = ["task"]
