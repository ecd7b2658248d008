"""Command-line verbs of experiments; import-light, so that `dreamfleet --help` needs no extra."""

__all__ = ["compare", "contrast", "demo", "iterate", "pipeline", "sweep", "verify_run"]
