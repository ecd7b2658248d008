"""Tasks: the contract between an environment, a policy and the rest of the system, and finding tasks by name.

Also what many tasks use: pictures, drivers, measures, resets. Pages: tasks.md, python.md.
"""

__all__ = [
    "api",
    "registry",
    "model_free_policies",
    "pictures",
    "measures",
    "recordable",
    "reset",
    "closing",
    "batches",
    "side_by_side",
    "watching",
    "true_state",
    "drivers",
]
