"""What a run can do without: each add-on registers itself by entry points."""

__all__ = ["environment_check"]
