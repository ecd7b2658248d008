"""A controller as a folder to publish.

Its pages: docs/how-to/export.md.
"""

__all__ = ["verb"]
