"""A controller as a folder to publish."""

__all__ = ["verb"]
