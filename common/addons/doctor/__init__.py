"""What a host can do: checks of `dreamfleet doctor`."""
