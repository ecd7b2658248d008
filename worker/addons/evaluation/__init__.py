"""Agents by name, and their scores on unseen episodes."""
