"""The bridge: batches over HTTP with JSON, for searches in any language. Pages: ask-tell.md."""

__all__ = ["verb"]
