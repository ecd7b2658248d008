"""Join files: an authority issues, lists and revokes them. Pages: security.md, share-a-fleet.md."""

__all__ = ["verb"]
