"""A data set of recorded drives: collected, stored, read. Pages: train.md, files.md, dreams-notes.md."""

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
