"""The worlds that ship: presets of their runs and trainings, published scores, demonstrations."""
