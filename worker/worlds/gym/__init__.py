"""Any gymnasium environment as a task, without a world model: `gym:LunarLander-v3`.

Its pages: docs/reference/tasks.md, docs/tutorials/own-environment.md.
"""

__all__ = ["task"]
