"""The finished phases of an iteration, in one file: files made, figures, requests and seed of each."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from dreamfleet.common.errors import UsageError
from dreamfleet.common.schema.validation import from_plain
from dreamfleet.experiments.iteration.config import CHANGEABLE, IterateConfig
from dreamfleet.experiments.iteration.plan import ALL, BUNDLE, DATA, EVOLVE, GATE, INIT, Phase
from dreamfleet.experiments.local.kept_document import read_document, write_document

FORMAT = 1
FIGURES: dict[str, dict[str, Any]] = {  # of a finished phase, which later phases and summaries read
    **{phase: {"new": int, "episodes": int} for phase in DATA},
    INIT: {"sha256": str, "controller": str},
    BUNDLE: {"sha256": str, "frames": int, "quality": dict},
    GATE: {"kept": bool, "why": str, "new": dict},
    EVOLVE: {"generations": int, "ended": str, "score": (dict, type(None))},
}
SCORE = {"mean": (int, float), "error": (int, float, type(None)), "episodes": int, "word": str, "confirmed": bool}


@dataclass(frozen=True)
class Artefact:
    """A file that a phase made: its path below the folder, and its SHA-256."""

    path: str
    sha256: str


@dataclass(frozen=True)
class FinishedPhase:
    """A finished phase: `seed` made it, `seconds` of its last attempt, `at` when it was finished (ISO 8601, UTC)."""

    round: int
    phase: str
    seed: int
    seconds: float
    at: str
    requests: tuple[dict[str, Any], ...] = ()
    figures: dict[str, Any] = field(default_factory=dict)
    made: tuple[Artefact, ...] = ()

    @property
    def phase_key(self) -> Phase:
        """The phase."""
        return Phase(self.round, self.phase)


@dataclass(frozen=True)
class IterationLedger:
    """The settings that an iteration was begun with, those of its runs, and what is finished, oldest first."""

    settings: dict[str, Any]
    run: dict[str, Any]
    entries: tuple[FinishedPhase, ...] = ()
    format: int = FORMAT

    @classmethod
    def begin(cls, config: IterateConfig, run: Mapping[str, Any]) -> IterationLedger:
        """The ledger of an iteration that has done nothing yet."""
        return cls(_plain(asdict(config)), _plain(run))

    @property
    def finished(self) -> tuple[Phase, ...]:
        """The finished phases, in order."""
        return tuple(each.phase_key for each in self.entries)

    def entry(self, number: int, phase: str) -> FinishedPhase | None:
        """A finished phase of a round; `None` if it is not."""
        return next((each for each in self.entries if each.phase_key == (number, phase)), None)

    def model_round(self, number: int) -> int:
        """The round whose world model counts after so many rounds: the last one that no gate refused.

        0: that of `--init`.
        """
        built = (each.round for each in self.entries if each.phase == BUNDLE and each.round <= number)
        return max((each for each in built if self.passed_gate(each)), default=0)

    def passed_gate(self, number: int) -> bool:
        """Whether a round's new world model was kept; without a gate it is."""
        gate = self.entry(number, GATE)
        return gate is None or bool(gate.figures["kept"])

    @property
    def episodes(self) -> int:
        """Drives that the data set holds."""
        return next((int(each.figures["episodes"]) for each in reversed(self.entries) if "episodes" in each.figures), 0)

    @property
    def files(self) -> frozenset[str]:
        """The paths of all files that were made."""
        return frozenset(made.path for each in self.entries for made in each.made)

    def add(self, entry: FinishedPhase) -> IterationLedger:
        """With one more phase."""
        return replace(self, entries=(*self.entries, entry))

    def before(self, phase: Phase) -> IterationLedger:
        """As it was before a finished phase."""
        return replace(self, entries=self.entries[: self.finished.index(phase)])

    def with_settings(self, config: IterateConfig, run: Mapping[str, Any], folder: Path) -> IterationLedger:
        """With changed settings; `UsageError` names those that differ and may not change."""
        wanted = _plain(asdict(config))
        begun = {**_plain(asdict(IterateConfig())), **self.settings}  # what is newer was its default
        known = {name: value for name, value in run.items() if name in self.run}
        differing = [*_differing(begun, wanted, CHANGEABLE), *_differing(self.run, known)]
        if differing:
            raise UsageError(f"{folder} was begun with {'; '.join(differing)}: omit that, or begin in another --data")
        return replace(self, settings=wanted)

    @classmethod
    def _parse(cls, plain: Any) -> IterationLedger:
        """`ValueError`, `TypeError` or `UsageError` if it is damaged."""
        found: IterationLedger = from_plain(cls, plain)
        if found.format != FORMAT:
            raise ValueError(f"it is of format {found.format}; this version reads {FORMAT}")
        known = {each.name for each in fields(IterateConfig)}
        if unknown := sorted(set(found.settings) - known):
            raise ValueError(f"it has settings that this version does not know: {', '.join(unknown)}")
        IterateConfig(**found.settings)
        for each in found.entries:
            _check(each)
        return found

    def save(self, path: Path) -> None:
        """Write it, whole or not at all."""
        write_document(path, asdict(self), "--data")

    @classmethod
    def load(cls, path: Path) -> IterationLedger | None:
        """The folder's ledger; `None` if it has none, `DatasetError` if it is damaged."""
        return read_document(path, cls._parse)


def as_data(request: Any) -> dict[str, Any]:
    """What a phase asked for: the fields of a request, or the words of a coordinator's command."""
    if isinstance(request, tuple):
        return {"command": list(request)}
    return {"request": type(request).__name__, **_plain(asdict(request))}


def _check(entry: FinishedPhase) -> None:
    """`ValueError` for an entry that no phase can have written."""
    if entry.phase not in (INIT, *ALL):
        raise ValueError(f"there is no phase {entry.phase!r:.40}")
    missing = _bad_figure(entry.figures, FIGURES.get(entry.phase, {}))
    missing = missing or _bad_figure(entry.figures.get("score") or {}, SCORE if entry.figures.get("score") else {})
    if missing:
        raise ValueError(f"phase {entry.phase_key} has no valid {missing}")


def _bad_figure(figures: Mapping[str, Any], wanted: Mapping[str, Any]) -> str:
    return next(
        (name for name, kind in wanted.items() if name not in figures or not isinstance(figures[name], kind)), ""
    )


def _differing(begun: Mapping[str, Any], wanted: Mapping[str, Any], free: frozenset[str] = frozenset()) -> list[str]:
    """The settings that differ, in words; values are compared as JSON stores them."""
    return [
        f"{name} {begun.get(name)}, not {value}"
        for name, value in _plain(wanted).items()
        if name not in free and begun.get(name) != value
    ]


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    plain: dict[str, Any] = json.loads(json.dumps(values, default=str))
    return plain
