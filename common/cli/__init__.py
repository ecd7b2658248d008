"""The command line: verbs, settings, output, progress. Pages: configure.md, settings.md, presets.md."""

__all__ = [
    "command_line",
    "parser",
    "config",
    "global_config",
    "bounds",
    "key_values",
    "presets",
    "world_flags",
    "output",
    "progress",
]
