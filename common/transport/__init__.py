"""Zenoh sessions, endpoints, queries and the router.

Its pages: docs/how-to/router.md, docs/reference/protocol.md, docs/explanation/threats.md.
"""

__all__ = ["session", "link_check", "query", "network"]
