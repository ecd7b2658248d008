"""The command line: verbs, settings, output, progress.

Its pages: docs/how-to/configure.md, docs/reference/settings.md, docs/reference/presets.md.
"""

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
