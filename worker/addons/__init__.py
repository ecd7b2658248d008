"""What scoring and training can do without: each add-on registers itself by entry points."""

__all__ = ["health"]
