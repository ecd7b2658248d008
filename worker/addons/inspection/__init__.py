"""Inspect a world model: an HTML page of what it sees, forgets and dreams, and figures measured on drives."""

__all__ = ["verb", "measure"]
