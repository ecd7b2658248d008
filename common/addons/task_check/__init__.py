"""A task tried in a child process before a run uses it."""
