"""Command-line verbs; import-light, so that `dreamfleet --help` needs no extra."""

__all__ = ["bar", "coordinator"]
