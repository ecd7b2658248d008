"""A read-only web page about live runs, over Zenoh, and past ones, from their journals on this disk.

Pages: dashboard.md, status.md.
"""

__all__ = ["verb"]
