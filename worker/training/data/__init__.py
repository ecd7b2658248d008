"""A data set of recorded drives: collected, stored, read.

Its pages: docs/how-to/train.md, docs/reference/files.md.
"""

__all__ = [
    "dataset",
    "data_folder",
    "collect_config",
    "collect",
    "pilot",
    "rollout_batches",
    "drive_steps",
    "recorded_states",
]
