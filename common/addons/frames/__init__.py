"""Pictures that a run or a view sends while it happens: `live` for programs, `mjpeg` for browsers."""

__all__ = ["live", "mjpeg"]
