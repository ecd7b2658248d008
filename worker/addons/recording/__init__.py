"""Videos of drives and dreams.

Its pages: docs/tutorials/first-drive.md, docs/reference/worlds.md.
"""

__all__ = ["verb", "recording", "drive_frames", "canvas", "parallel_dream", "video"]
