"""Settings of runs to begin with, by name."""

from typing import Any

from dreamfleet.common.cli.presets import check_preset
from dreamfleet.common.errors import UsageError
from dreamfleet.common.worlds.shipped import WORLDS

# The dream of any world that a bundle describes.
PIXELS: dict[str, Any] = {
    "task": "dream",
    "population": 32,
    "episodes": 8,
    "sigma0": 0.1,
    "covariance": "diagonal",
    "temperature": 1.15,
    "evaluate_every": 10,
    "evaluation_episodes": 16,
    "confirm_episodes": 32,
}
PRESETS = {"pixels": PIXELS, **{name: each for world in WORLDS.values() for name, each in world.run_presets.items()}}


def check_preset_fits(name: str | None, world: str, bundle: str = "") -> None:
    """`UsageError` if a preset was made for a named world model, and the run's `bundle` or task is of another `world`.

    Presets that name no world model, such as dream, are of any.
    """
    own = next((each.task for each in WORLDS.values() if "bundle" in each.run_presets.get(name or "", {})), world)
    if own != world:
        with_bundle = f"{bundle} is a world model of {world}: give --preset pixels"
        other = with_bundle if bundle else f"the task is {world}: omit --preset"
        raise UsageError(f"the preset {name} is of {own}, and {other}")


def find_preset(name: str) -> dict[str, Any]:
    """The preset of a run of that name; `UsageError` lists those that exist."""
    return PRESETS[check_preset("run", name)]
