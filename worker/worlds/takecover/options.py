"""How Take Cover is played: what a run, or a world model's data, freezes of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, Literal

from dreamfleet.common.artifacts.task_options import check_options, read_options, write_options
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.tasks.pictures import SHORTEST, Crop, cut_and_resize, is_crop, parse_crop
from dreamfleet.worker.tasks.recordable import Preprocessing
from dreamfleet.worker.worldmodel.vae_config import SIDES
from dreamfleet.worker.worlds.takecover.game import HEIGHT, LIMIT, TICS_PER_SECOND, WIDTH

OPTION_HELP = {
    "tics": "a whole number from 1 to 10",
    "actions": "choices or thirds",
    "crop": f"TOP:BOTTOM,LEFT:RIGHT of a picture of {HEIGHT} rows and {WIDTH} columns, with {SHORTEST} of each or more",
}
FLAGS = {"skip": "tics", "crop": "crop"}  # of any world, and what they are here
KNOWN = ("environment", *FLAGS)


@dataclass(frozen=True)
class TakeCoverOptions:
    """The options of task `takecover`; `UsageError` for a value out of range.

    >>> TakeCoverOptions.parse('{"environment": {"tics": 1}}').horizon
    2100
    """

    tics: int = 4  # for which a decision holds
    actions: Literal["choices", "thirds"] = "choices"  # stay, left, right; or one number from -1 to 1, cut in thirds
    crop: str = f"40:88,0:{WIDTH}"  # of the game's picture, what a world model sees: all fireballs, little else

    def __post_init__(self) -> None:
        valid = {
            "tics": type(self.tics) is int and 1 <= self.tics <= 10,
            "actions": self.actions in ("choices", "thirds"),
            "crop": _is_crop(self.crop),
        }
        for name, is_valid in valid.items():
            if not is_valid:
                raise UsageError(f"takecover's {name} must be {OPTION_HELP[name]}, not {getattr(self, name)!r}")

    @classmethod
    def parse(cls, text: str) -> TakeCoverOptions:
        """The options in a JSON object as `text` gives it; an empty text names none."""
        return cls.of(read_options("takecover", text, KNOWN))

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> TakeCoverOptions:
        """The options in a mapping: `environment` holds them by name; `skip` and `crop` are tics and crop."""
        check_options("takecover", given, KNOWN)
        values = given.get("environment") or {}
        unknown = sorted(set(values) - set(OPTION_HELP)) if isinstance(values, Mapping) else [repr(values)]
        if unknown:
            named = ", ".join(unknown)
            raise UsageError(f"takecover knows no argument {named:.200}: known are {', '.join(OPTION_HELP)}")
        for flag, name in FLAGS.items():
            if flag in given and values.get(name, given[flag]) != given[flag]:
                both = f"--{flag} {given[flag]!r:.50} and --environment {name}={values[name]!r:.50}"
                raise UsageError(f"{both} say the same thing: give one of them")
        return cls(**{**{name: given[flag] for flag, name in FLAGS.items() if flag in given}, **values})

    @property
    def text(self) -> str:
        """The options that differ from the defaults as canonical JSON; empty if none does."""
        changed = {each.name: value for each in fields(self) if (value := getattr(self, each.name)) != each.default}
        return write_options({"environment": changed} if changed else {})

    @property
    def horizon(self) -> int:
        """Decisions of the longest episode."""
        return -(-LIMIT // self.tics)

    @property
    def frames_per_second(self) -> int:
        """Decisions of a second."""
        return max(1, round(TICS_PER_SECOND / self.tics))

    @property
    def part(self) -> Crop:
        """The crop's first row and the one after its last, then its columns."""
        part = parse_crop(self.crop)
        assert part is not None  # `__post_init__` has checked it
        return part

    @property
    def preprocessings(self) -> dict[str, Preprocessing]:
        """What a world model sees, in the sizes that it may have: the crop, resized."""
        crop = "" if self.crop == TakeCoverOptions.crop else f" of {self.crop}"
        names = {size: f"box-{size}{crop}" for size in SIDES}
        cut = partial(cut_and_resize, crop=self.part)
        return {name: Preprocessing(name, size, partial(cut, size=size)) for size, name in names.items()}


def _is_crop(text: Any) -> bool:
    crop = parse_crop(text) if isinstance(text, str) else None
    return crop is not None and is_crop(crop, HEIGHT, WIDTH)
