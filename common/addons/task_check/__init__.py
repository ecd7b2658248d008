"""A task tried in a child process before a run uses it. Pages: tasks.md, own-environment.md."""

__all__ = ["verb", "task_check"]
