"""Settings of runs to begin with, by name."""

from __future__ import annotations

from typing import Any

from dreamfleet.common.cli.presets import check_preset
from dreamfleet.common.runs.records import StageSettings

# A few generations in the dream, then reality, in the features that ship; docs/results.md says what each is for.
REAL: dict[str, Any] = {
    "task": "dream",
    "bundle": "tiny",
    "subspace": "tiny",
    "population": 64,
    "episodes": 16,
    "sigma0": 0.3,
    "covariance": "full",
    "horizon": 400,
    "temperature": 1.5,
    "evaluate_every": 5,
    "evaluation_episodes": 32,
    "confirm_episodes": 64,
    "stages": (
        StageSettings(generations=5),
        StageSettings(steps=1_800_000, driven=1.0, horizon=1000, patience=100, population=24, episodes=4, sigma0=0.06),
        StageSettings(steps=5_000_000, episodes=8),
        StageSettings(episodes=16),
    ),
}
# Both pedals of these two sources are half down at an output of 0.
HALF_PEDALS = ("pedals=half",)
# Take Cover: a decision holds for 4 tics, so that 525 are the game's limit. Long searches find what the dream alone
# allows, so each mean is looked at, and the confirmation chooses.
TAKE_COVER: dict[str, Any] = {
    "task": "dream",
    "bundle": "takecover",
    "population": 64,
    "episodes": 16,
    "sigma0": 0.1,
    "covariance": "diagonal",
    "horizon": 525,
    "temperature": 1.15,
    "evaluate_every": 15,
    "evaluation_episodes": 100,
    "confirm_episodes": 100,
}
# The settings of the sources, and what two cores do in minutes.
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {"population": 64, "episodes": 16, "sigma0": 0.1, "covariance": "full", "evaluation_episodes": 1024},
    "article": {
        "preset_variant": HALF_PEDALS,
        "population": 32,
        "episodes": 4,
        "sigma0": 0.1,
        "covariance": "full",
        "evaluation_episodes": 100,
    },
    # Ten generations of dreams, and then a drive.
    "notebook": {
        "task": "dream",
        "preset_variant": HALF_PEDALS,
        "population": 256,
        "episodes": 5,
        "sigma0": 0.1,
        "covariance": "full",
        "horizon": 1000,
        "temperature": 1.0,
        "evaluate_every": 10,
        "evaluation_episodes": 16,
    },
    "dream": {
        "task": "dream",
        "population": 64,
        "episodes": 16,
        "sigma0": 0.1,
        "covariance": "diagonal",
        "horizon": 400,
        "temperature": 1.5,
        "evaluate_every": 5,
        "evaluation_episodes": 16,
        "confirm_episodes": 32,
    },
    "frugal": {"population": 32, "episodes": 2, "sigma0": 0.1, "covariance": "diagonal", "patience": 100},
    # The dream of any world that a bundle describes.
    "pixels": {
        "task": "dream",
        "population": 32,
        "episodes": 8,
        "sigma0": 0.1,
        "covariance": "diagonal",
        "temperature": 1.15,
        "evaluate_every": 10,
        "evaluation_episodes": 16,
        "confirm_episodes": 32,
    },
    "takecover": TAKE_COVER,
    # In the game itself, by what the world model sees and remembers.
    "takecover-real": {
        "task": "takecover",
        "bundle": "takecover",
        "population": 24,
        "episodes": 4,
        "sigma0": 0.06,
        "covariance": "diagonal",
        "horizon": 525,
        "evaluate_every": 10,
        "evaluation_episodes": 100,
        "confirm_episodes": 100,
    },
    "real": REAL,
    # Each candidate drives one track and dreams another: docs/dreams.md, "Some of reality in it".
    "mixed": {
        **REAL,
        "stages": (
            StageSettings(generations=5),
            StageSettings(driven=0.5, horizon=1000, patience=100, population=24, episodes=2, sigma0=0.15),
        ),
    },
}


def find_preset(name: str) -> dict[str, Any]:
    """The preset of a run of that name; `UsageError` lists those that exist."""
    return PRESETS[check_preset("run", name)]
