"""The bridge: batches over HTTP with JSON, for searches in any language.

Its pages: docs/how-to/ask-tell.md.
"""

__all__ = ["verb"]
