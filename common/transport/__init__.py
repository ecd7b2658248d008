"""Zenoh sessions, endpoints, queries and the router. Pages: router.md, protocol.md, threats.md."""

__all__ = ["session", "link_check", "query", "network"]
