"""Inspect a world model: an HTML page of what it sees, forgets and dreams, and figures measured on drives.

Pages: train.md, dreams.md, own-world-model.md, dreams-notes.md.
"""

__all__ = ["verb", "measure"]
