"""Runs as they lie on disk, and what is computed from their records."""
