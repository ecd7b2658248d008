"""Command-line verbs of experiments; import-light, so that `dreamfleet --help` needs no extra."""
