"""Evolve World-Models controllers on whatever machines you have."""
