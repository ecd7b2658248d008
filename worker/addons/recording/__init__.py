"""Videos of drives and dreams."""

__all__ = ["verb", "video_cli", "recording", "drive_frames", "canvas", "parallel_dream", "video"]
