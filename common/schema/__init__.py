"""Conversion of plain data to typed objects and back: validation, bounds, optional fields."""

__all__ = ["validation", "display", "times"]
