"""Command-line verbs; import-light, so that `dreamfleet --help` needs no extra."""

__all__ = ["worker", "collect", "train", "encode"]
