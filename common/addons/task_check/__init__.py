"""A task tried in a child process before a run uses it.

Its pages: docs/reference/tasks.md, docs/tutorials/own-environment.md.
"""

__all__ = ["verb", "task_check"]
