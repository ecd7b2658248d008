"""Inspect a world model: an HTML page of what it sees, forgets and dreams, and figures measured on drives.

Its pages: docs/how-to/train.md, docs/explanation/dreams.md, docs/tutorials/own-world-model.md.
"""

__all__ = ["verb", "measure"]
