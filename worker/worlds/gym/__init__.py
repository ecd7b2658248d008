"""Any gymnasium environment as a task, without a world model: `gym:LunarLander-v3`."""

__all__ = ["task"]
