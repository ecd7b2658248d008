"""The bridge: batches over HTTP with JSON, for searches in any language."""

__all__ = ["verb"]
