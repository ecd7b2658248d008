"""Pictures that a run or a view sends while it happens: `live` for programs, `mjpeg` for browsers.

Pages: watch.md, protocol.md.
"""

__all__ = ["live", "mjpeg"]
