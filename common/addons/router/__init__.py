"""A Zenoh router between hosts that do not reach each other.

Its pages: docs/how-to/router.md, docs/how-to/security.md.
"""

__all__ = ["verb"]
