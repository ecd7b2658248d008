"""Files: atomic writes, bounded archives, locks, TensorBoard event files."""
