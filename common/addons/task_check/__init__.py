"""A task tried in a child process before a run uses it."""

__all__ = ["verb", "task_check"]
