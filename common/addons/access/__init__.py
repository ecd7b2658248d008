"""Join files: an authority issues, lists and revokes them.

Its pages: docs/how-to/security.md, docs/how-to/share-a-fleet.md.
"""

__all__ = ["verb"]
