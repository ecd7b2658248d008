"""Code that the coordinator and the worker share: protocol, artifacts, run records, configuration, client."""

__all__ = ["errors", "printable"]
