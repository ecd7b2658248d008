"""The names of all kinds of presets: settings of a run, amounts and layers of training, and learning baselines.

Each side holds its own settings; the names stand here, so that either can say that a name is the other's.
"""

from __future__ import annotations

from typing import Literal

from dreamfleet.common.errors import UsageError

Kind = Literal["run", "training", "baseline"]
NAMES: dict[Kind, tuple[str, ...]] = {
    "run": ("article", "dream", "frugal", "mixed", "notebook", "paper", "real"),
    "training": ("article", "attentive", "notebook", "paper", "tiny"),
    "baseline": ("learning", "notebook"),
}
VERBS: dict[Kind, str] = {
    "run": "coordinator and fork", "training": "collect and train", "baseline": "baseline train",
}  # fmt: skip


def check_preset(kind: Kind, name: str) -> str:
    """Return `name` if such a preset exists, else raise `UsageError`; it says if the name is one of the other kind."""
    if name in NAMES[kind]:
        return name
    others = [other for other in NAMES if name in NAMES[other]]
    hint = f"; {name!r} is a preset of {others[0]}, for {VERBS[others[0]]}" if others else ""
    raise UsageError(f"unknown {kind} preset {name!r}: choose one of {', '.join(NAMES[kind])}{hint}")


def preset_help_text(kind: Kind) -> str:
    """What `--help` says of the presets of one kind."""
    told = f"{kind} preset to begin with: {', '.join(NAMES[kind])}"
    kept = "; a data set keeps the one that it was begun with, and each verb must name it unless it is tiny"
    return f"{told} (default tiny{kept})" if kind == "training" else told
