"""What a run is: settings, presets, schedule, starting point, limits, network; how it is resumed or rerun.

Pages: settings.md, presets.md, stages.md.
"""

__all__ = [
    "config",
    "presets",
    "network",
    "limits",
    "live_log",
    "stage_tables",
    "start",
    "freezing",
    "fork",
    "resume_settings",
    "run_setup",
    "run_provenance",
]
