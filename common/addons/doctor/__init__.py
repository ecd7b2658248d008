"""What a host can do: checks of `dreamfleet doctor`.

Its pages: docs/how-to/troubleshooting.md, docs/tutorials/first-drive.md.
"""

__all__ = ["verb", "health"]
