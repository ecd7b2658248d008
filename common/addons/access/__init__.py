"""Join files: an authority issues, lists and revokes them."""

__all__ = ["verb"]
