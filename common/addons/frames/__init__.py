"""Pictures that a run or a view sends while it happens: `live` for programs, `mjpeg` for browsers.

Its pages: docs/how-to/watch.md, docs/reference/protocol.md.
"""

__all__ = ["live", "mjpeg"]
