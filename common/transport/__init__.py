"""Zenoh sessions, endpoints, queries and the router."""

__all__ = ["session", "query", "network"]
