"""Any Python function of a vector as a task: `function:MODULE:NAME`."""

__all__ = ["task"]
