"""Pictures that a run or a view sends while it happens."""

__all__ = ["live", "mjpeg"]
