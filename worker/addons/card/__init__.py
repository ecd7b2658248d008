"""A controller as a folder to publish. Pages: export.md."""

__all__ = ["verb"]
