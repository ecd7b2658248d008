"""Files: atomic writes, bounded archives, locks, file systems, SQLite, TensorBoard event files."""

__all__ = ["atomic_write", "regular_files", "archives", "locks", "file_system", "sqlite", "tensorboard"]
