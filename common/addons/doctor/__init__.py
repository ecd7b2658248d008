"""What a host can do: checks of `dreamfleet doctor`."""

__all__ = ["verb", "health"]
