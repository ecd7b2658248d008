"""Any Python function of a vector as a task: `function:MODULE:NAME`. Pages: own-objective.md, tasks.md."""

__all__ = ["task"]
