"""Command lines of the verbs that make and evolve world models, which other verbs run one after the other. Pure.

Each function returns the words behind `dreamfleet`. Of a flag that is given twice, the latter counts.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Literal

from dreamfleet.common.cli.key_values import as_setting
from dreamfleet.common.errors import UsageError

Words = tuple[str, ...]
Model = Literal["vae", "mdnrnn"]
MODELS: tuple[Model, ...] = ("vae", "mdnrnn")
TRAINING_FLAGS = frozenset(  # of `train`, whose other settings are keys of `--set`
    {"--data", "--preset", "--device", "--continue-from", "--new", "--decoder-only", "--summary", "--tensorboard",
     "--json", "--updates", "--batch", "--rate", "--seed", "--set", "--config", "--quiet", "--log-level"}
)  # fmt: skip
WORLD_FLAGS = ("task", "environment", "observation", "crop", "size", "skip", "difference")  # as `collect` has them


def command(*parts: object) -> Words:
    """A command line from words, numbers and paths."""
    return tuple(map(str, parts))


def options(**values: object) -> Words:
    """`--name value` of each value that is not None; `_` in a name is `-`."""
    return command(*(word for name, value in values.items() if value is not None for word in (_flag(name), value)))


def world_flags(given: Mapping[str, object]) -> Words:
    """The flags of `collect` that say which world a new data set is of: those of `given` that are set.

    >>> world_flags({"task": "gym:ALE/Pong-v5", "skip": 4, "environment": ("mode=1",), "crop": None, "jobs": 2})
    ('--task', 'gym:ALE/Pong-v5', '--environment', 'mode=1', '--skip', '4')
    """
    words: list[object] = []
    for name in WORLD_FLAGS:
        value = given.get(name)
        if value is True:
            words.append(_flag(name))
        elif isinstance(value, (tuple, list)) and value:
            words += [_flag(name), *value]
        elif value:
            words += [_flag(name), value]
    return command(*words)


def collect(
    data: Path, *more: object, preset: str, seed: int, episodes: object = None, steps: int | None = None,
    jobs: int | None = None,
) -> Words:  # fmt: skip
    """Drives for the data set in `data`, until it has `episodes` of them."""
    given = options(preset=preset, seed=seed, episodes=episodes, steps=steps, jobs=jobs)
    return command("collect", "--data", data, *given, *more, "--json")


def train(
    model: Model, data: Path, *more: object, seed: int, preset: str | None = None, device: str | None = None
) -> Words:
    """The training of one model on the data set in `data`.

    Settings may stand among `more` as the flags that they once were, as files of begun work have them.

    >>> " ".join(train("vae", Path("d"), "--updates", 9, "--channels", 8, 16, "--batch-norm", seed=1))
    'train vae --data d --seed 1 --json --updates 9 --set channels=8,16 --set batch_norm=true'
    """
    given = options(preset=preset, device=device, seed=seed)
    return command("train", model, "--data", data, *given, "--json", *with_settings(command(*more)))


def encode(data: Path) -> Words:
    """The latents of the drives in `data`."""
    return command("encode", "--data", data, "--json")


def bundle(data: Path, out: Path, *more: object) -> Words:
    """The models in `data` as one file."""
    return command("bundle", "--data", data, "--out", out, "--json", *more)


def begin_run(
    name: str, runs_dir: Path, listen: Sequence[str], *flags: object, world_model: Path | str | None = None,
    as_json: bool = True, **more: object,
) -> Words:  # fmt: skip
    """The coordinator of a new run; `flags` come first, so that `more`, such as `seed`, counts."""
    return command(
        "coordinator", *flags, "--run", name, *options(bundle=world_model, **more),
        *_run_place(runs_dir, listen, as_json=as_json),
    )  # fmt: skip


def resume_run(name: str, runs_dir: Path, listen: Sequence[str], *flags: object) -> Words:
    """The coordinator of a run that was begun before."""
    return command("coordinator", "--resume", name, *flags, *_run_place(runs_dir, listen, as_json=True))


def worker(run: str, endpoint: str, slots: int, *more: object) -> Words:
    """A worker of one run, reached at `endpoint`."""
    return command("worker", "--connect", endpoint, "--run", run, "--slots", slots, *more)


def evaluate(controller: Path, episodes: int, *more: object) -> Words:
    """A controller on so many unseen seeds."""
    return command("evaluate", "--controller", controller, "--episodes", episodes, *more)


def use_bundle(path: Path) -> tuple[Words, Words]:
    """What to do with a world model: look into it, and evolve in it; the coordinator says how a worker joins."""
    return command("inspect", path), command("coordinator", "--run", "mine", "--bundle", path)


def split_flags(flag: str, text: str, owner: str = "", reserved: Sequence[str] = ()) -> Words:
    """Flags of another verb that `flag` was given as one text.

    `UsageError` if quotes do not match, or if one is in `reserved`, which `owner` sets itself.
    """
    try:
        words = tuple(shlex.split(text))
    except ValueError as error:
        raise UsageError(f"{flag} {text!r}: {error}") from error
    given = {word.partition("=")[0] for word in words if word.startswith("--")}
    if taken := [each for each in reserved if any(each.startswith(word) for word in given)]:  # a short form too
        raise UsageError(f"{flag}: omit {', '.join(taken)}, which {owner} sets itself")
    return words


def with_settings(words: Words) -> Words:
    """The same flags of a training, where those that are settings now stand as `--set KEY=VALUE`."""
    found: list[str] = []
    rest = list(words)
    while rest:
        flag, equals, value = rest.pop(0).partition("=")
        values = [value] if equals else list(takewhile(lambda word: not word.startswith("--"), rest))
        rest = rest if equals else rest[len(values) :]
        if not flag.startswith("--") or flag in TRAINING_FLAGS:
            found += [flag, *values]
        else:
            found += ["--set", as_setting(flag, values)]
    return tuple(found)


def _run_place(runs_dir: Path, listen: Sequence[str], *, as_json: bool) -> Words:
    return command("--runs-dir", runs_dir, *(("--json",) if as_json else ()), "--listen", *listen)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
