"""A sweep: what its runs share, what varies, the runs that follow, and how they are served. Pure."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import prod
from typing import Any

from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.keys import check_run_name
from dreamfleet.experiments.local.command_lines import MOST_WORKERS, Words

MOST_RUNS = 1000  # of one sweep
_RANGE = re.compile(r"(-?\d+)\.\.(-?\d+)")
_DASHED = re.compile(r"(0|[1-9]\d*)-([1-9]\d*)")
SEED = "seed"  # runs that differ in it alone are one setting's repetitions
PARALLEL, MOST_PARALLEL = 4, 64
Vary = dict[str, tuple[str, ...]]  # flag of `coordinator` without `--` -> its values


@dataclass(frozen=True)
class SweepRun:
    """One run of a sweep: its name, and the values of the settings that vary."""

    name: str
    values: tuple[tuple[str, str], ...]

    @property
    def setting(self) -> str:
        """Its values without the seed, in words: equal for all repetitions."""
        return ", ".join(f"{key} {value}" for key, value in self.values if key != SEED) or "all equal"

    @property
    def flags(self) -> Words:
        """The flags of its coordinator alone; the values true and false stand for a flag and its `--no-`."""
        switches = {"true": "--", "false": "--no-"}
        return tuple(
            f"{switches[value]}{key}" if value in switches else f"--{key}={value}" for key, value in self.values
        )


@dataclass(frozen=True)
class Sweep:
    """The name of a sweep, what varies, and the flags of `coordinator` that all its runs have."""

    name: str
    vary: Vary
    flags: Words = ()

    def __post_init__(self) -> None:
        check_run_name(self.name)
        if not self.vary:
            raise UsageError("nothing varies: give --vary SETTING=VALUES, such as --vary seed=1..5 population=8,32")
        if (count := prod(len(values) for values in self.vary.values())) > MOST_RUNS:
            raise UsageError(f"{count:,} runs are more than a sweep's {MOST_RUNS:,}: vary less, or in several sweeps")
        names = [each.name for each in self.runs]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise UsageError(f"two runs of the sweep would be called {twice[0]}: leave out one of their values")

    @cached_property
    def runs(self) -> tuple[SweepRun, ...]:
        """All runs: of each setting the first seed, then of each the second, so that an early end compares evenly."""
        keys = sorted(self.vary, key=lambda key: key != SEED)
        found = []
        for values in product(*(self.vary[key] for key in keys)):
            by_key = dict(zip(keys, values, strict=True))
            ordered = tuple((key, by_key[key]) for key in self.vary)
            name = "-".join((self.name, *(_name_part(key, value) for key, value in ordered)))
            found.append(SweepRun(check_run_name(name), ordered))
        return tuple(found)


@dataclass(frozen=True)
class SweepOptions:
    """What flags or a file say of serving a sweep, and defaults for the rest; `UsageError` if it cannot be."""

    parallel: int = option(PARALLEL, "runs that are open at once")
    workers: int | None = option(
        None, "workers of one slot on this host (default one a core, or none with --connect); 0: only others'"
    )
    listen: tuple[str, ...] = option((), "endpoints of its router")
    connect: tuple[str, ...] = option((), "endpoints of another router")
    insecure: bool = option(False, "listen to anyone")

    def __post_init__(self) -> None:
        if not 1 <= self.parallel <= MOST_PARALLEL:
            raise UsageError(f"--parallel must be from 1 to {MOST_PARALLEL}, not {self.parallel}")
        if self.workers is not None and not 0 <= self.workers <= MOST_WORKERS:
            raise UsageError(f"--workers must be from 0 to {MOST_WORKERS}, not {self.workers}")
        if self.listen and self.connect:
            raise UsageError("--listen starts a router here and --connect uses another one: give one of them")


def staggered_share(number: int, parallel: int) -> float:
    """The share of run `number` of a sweep: runs of equal size end one after another, so that no slot idles between.

    Else all open runs would end at once, and the fleet would wait for the start of the next ones. The mean is 1.

    >>> [staggered_share(number, 3) for number in range(4)]
    [0.5, 1.0, 1.5, 0.5]
    """
    return 2 * (1 + number % parallel) / (parallel + 1)


def parse_vary(texts: Sequence[str]) -> Vary:
    """What varies, from SETTING=VALUES: values are separated by commas, or a range of whole numbers.

    >>> parse_vary(["seed=1..3", "sigma0=0.05,0.1"])
    {'seed': ('1', '2', '3'), 'sigma0': ('0.05', '0.1')}
    """
    found: Vary = {}
    for text in texts:
        key, equals, values = text.partition("=")
        key = key.strip().replace("_", "-")
        if not (key and equals and values.strip()):
            raise UsageError(f"--vary {text!r}: write SETTING=VALUES, such as seed=1..5 or population=8,32")
        _add(found, key, tuple(_split(text, values)))
    return found


def read_vary(table: Any) -> Vary:
    """What varies, from the table [vary] of a file: each value a list, or a text as of `--vary`.

    >>> read_vary({"seed": "1..2", "sigma0": [0.05, 0.1], "racing": [True, False]})
    {'seed': ('1', '2'), 'sigma0': ('0.05', '0.1'), 'racing': ('true', 'false')}
    """
    if not isinstance(table, dict):
        raise UsageError("[vary] must be a table, such as seed = [1, 2, 3]")
    found: Vary = {}
    for key, values in table.items():
        if isinstance(values, str):
            found |= parse_vary([f"{key}={values}"])
        elif isinstance(values, list) and values and all(isinstance(each, (str, int, float)) for each in values):
            texts = (str(each).lower() if isinstance(each, bool) else str(each) for each in values)
            _add(found, key.replace("_", "-"), tuple(texts))
        else:
            raise UsageError(f"{key} in [vary] must be a list of values, or a text such as '1..5'")
    return found


def _add(found: Vary, key: str, values: tuple[str, ...]) -> None:
    if key in found:
        raise UsageError(f"{key} varies twice: give all its values at once")
    if len(values) > MOST_RUNS:
        raise UsageError(f"{key} has {plural(len(values), 'value')}, more than the {MOST_RUNS:,} runs of a sweep")
    if twice := next((value for value in values if values.count(value) > 1), None):
        raise UsageError(f"{key} has the value {twice} twice")
    found[key] = values


def _split(text: str, values: str) -> Iterator[str]:
    for part in (each.strip() for each in values.split(",")):
        if not part:
            raise UsageError(f"--vary {text!r}: a value is empty")
        if dashed := _DASHED.fullmatch(part):
            raise UsageError(f"--vary {text!r}: a range is {dashed[1]}..{dashed[2]}, with two dots")
        if span := _RANGE.fullmatch(part):
            low, high = int(span[1]), int(span[2])
            if not 0 <= high - low < MOST_RUNS:
                raise UsageError(f"--vary {text!r}: a range goes up, and over {MOST_RUNS:,} values at most")
            yield from map(str, range(low, high + 1))
        else:
            yield part


def _name_part(key: str, value: str) -> str:
    """A value in a run's name, which has only a-z, 0-9 and '-': of gym:CartPole-v1 gym-cartpole-v1.

    >>> _name_part("sigma0", "0.05")
    'sigma0-0-05'
    >>> _name_part("seed", "3")
    'seed3'
    """
    plain = re.sub(r"[^a-z0-9]+", "-", value.lower()).strip("-")
    return f"{key}{'' if plain.isdigit() and not key[-1].isdigit() else '-'}{plain}"
