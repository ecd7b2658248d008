"""The worlds that ship; each is a task, registered by its entry point.

Its pages: docs/reference/tasks.md, docs/reference/worlds.md.
"""
