"""Drives and dreams in a window while they happen."""
