"""Videos of drives and dreams. Pages: first-drive.md, worlds.md."""

__all__ = ["verb", "recording", "drive_frames", "canvas", "parallel_dream", "video"]
