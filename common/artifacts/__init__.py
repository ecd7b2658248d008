"""Files that a run reads and writes: bundles, controllers, agents, subspaces.

Its pages: docs/reference/files.md, docs/reference/worlds.md, docs/reference/import.md, docs/explanation/determinism.md.
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
    "trained_agent",
    "onnx_checks",
]
