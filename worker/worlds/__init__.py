"""The worlds that ship; each is a task, registered by its entry point. Pages: tasks.md, worlds.md."""
