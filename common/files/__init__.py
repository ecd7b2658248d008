"""Files: atomic writes, bounded archives, folder locks, event files."""
