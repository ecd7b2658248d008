"""Names of presets: of a run's settings, of a training's settings, and of learning baselines.

The coordinator and the worker define their own presets. The names are here so that an error can say which verb knows a
preset of that name. docs/reference/presets.md lists all. Pages: train.md, worlds.md.
"""

from typing import Literal

from dreamfleet.common.artifacts.driving import FIRST_WORLD
from dreamfleet.common.errors import UsageError
from dreamfleet.common.worlds.profile import WorldProfile
from dreamfleet.common.worlds.shipped import WORLDS

Kind = Literal["run", "training", "baseline"]
# Worlds that ship have presets of their own; `pixels` is of any world, and the other trainings here are of the first.
_OF_RUNS = [name for world in WORLDS.values() for name in world.run_presets]
_OF_TRAININGS = [name for world in WORLDS.values() for name in world.training_presets]
NAMES: dict[Kind, tuple[str, ...]] = {
    "run": tuple(sorted(("pixels", *_OF_RUNS))),
    "training": tuple(sorted(("article", "attentive", "notebook", "paper", "pixels", "tiny", *_OF_TRAININGS))),
    "baseline": ("learning", "notebook"),
}
VERBS: dict[Kind, str] = {"run": "coordinator", "training": "collect and train", "baseline": "baseline train"}


def default_training_preset(task: str) -> str:
    """The training preset of a new data set of a task; an empty text is the first world.

    >>> default_training_preset(""), default_training_preset("gym:ALE/Pong-v5")
    ('tiny', 'pixels')
    """
    world = WORLDS.get(task or FIRST_WORLD)
    return world.default_training if world else "pixels"


def default_run_preset(task: str) -> str:
    """The preset of a run in the dream of a task's world model; an empty text is the first world.

    >>> default_run_preset(""), default_run_preset("takecover"), default_run_preset("gym:ALE/Pong-v5")
    ('dream', 'takecover', 'pixels')
    """
    return (WORLDS.get(task or FIRST_WORLD) or WorldProfile(task=task)).dream_preset


def check_preset(kind: Kind, name: str) -> str:
    """Return `name` if a preset of this kind has it, else raise `UsageError`, with a hint if another kind has it."""
    if name in NAMES[kind]:
        return name
    others = [other for other in NAMES if name in NAMES[other]]
    hint = f"; {name!r} is a preset of {others[0]}, for {VERBS[others[0]]}" if others else ""
    raise UsageError(f"unknown {kind} preset {name!r}: choose one of {', '.join(NAMES[kind])}{hint}")


def preset_help_text(kind: Kind) -> str:
    """The `--help` text for the presets of one kind."""
    text = f"{kind} preset, whose settings flags may change: {', '.join(NAMES[kind])}"
    note = "; a data set stores its preset, and each verb must name that one unless it is tiny"
    return f"{text} (default tiny{note})" if kind == "training" else text
