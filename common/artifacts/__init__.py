"""Files that a run reads and writes: bundles, controllers, subspaces; and what their vectors mean to a task.

Pages: files.md, worlds.md, import.md, determinism.md.
"""

__all__ = [
    "controller",
    "actions",
    "subspace",
    "bundle",
    "bundle_store",
    "world_facts",
    "task_options",
    "driving",
    "car_racing_variants",
    "objective",
    "onnx_checks",
]
