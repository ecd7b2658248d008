"""What every host knows of the worlds that ship, without their simulators: a file of facts for each world.

Its pages: docs/reference/worlds.md, docs/reference/tasks.md.
"""

__all__ = ["profile", "shipped", "score_words"]
