"""The command line: verbs, settings, output, progress."""
