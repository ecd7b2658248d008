"""Files: atomic writes, bounded archives, locks, TensorBoard event files.

Its pages: docs/reference/files.md, docs/how-to/unattended.md.
"""

__all__ = ["atomic_write", "regular_files", "archives", "locks", "file_system", "sqlite", "tensorboard"]
