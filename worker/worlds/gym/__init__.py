"""Any gymnasium environment as a task, without a world model: `gym:LunarLander-v3`.

Pages: tasks.md, own-environment.md.
"""

__all__ = ["task"]
