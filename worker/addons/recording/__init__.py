"""Videos of drives and dreams."""

__all__ = ["verb", "recording", "drive_frames", "canvas", "parallel_dream", "video"]
