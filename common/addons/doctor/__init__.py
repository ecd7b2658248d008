"""What a host can do: checks of `dreamfleet doctor`. Pages: troubleshooting.md, first-drive.md."""

__all__ = ["verb", "health"]
