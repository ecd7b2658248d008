"""A read-only web page about live runs, over Zenoh, and past ones, from their journals on this disk.

Its pages: docs/how-to/dashboard.md, docs/reference/status.md.
"""

__all__ = ["verb"]
