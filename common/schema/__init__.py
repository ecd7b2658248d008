"""Conversion of plain data to typed objects and back: validation, bounds, optional fields.

Its pages: docs/reference/protocol.md.
"""

__all__ = ["validation", "display", "times"]
