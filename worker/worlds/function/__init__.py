"""Any Python function of a vector as a task: `function:MODULE:NAME`.

Its pages: docs/tutorials/own-objective.md, docs/reference/tasks.md.
"""

__all__ = ["task"]
