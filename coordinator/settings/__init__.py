"""What a run is: settings, presets, schedule, starting point, how it is resumed or rerun."""
