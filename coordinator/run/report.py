"""What a run reports: never the luckiest sample.

While it goes on, its best evaluated mean, which is provisional: the best of many looks is in part luck. As it ends, the
mean that was confirmed, with a score that chose nothing. Without evaluations, the last mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import JournalError
from dreamfleet.common.runs.records import RunSettings, StoredConfirmation, StoredEvaluation
from dreamfleet.common.runs.run_provenance import RECEIPT, RunProvenance
from dreamfleet.common.serialization.optional_fields import to_dict

SAVE_INTERVAL = 5.0  # seconds between two writings of a mean that was not evaluated: each waits for the disk


@dataclass(frozen=True)
class ValidationScore:
    """A mean's score on validation tracks. Unless it is `confirmed`, these tracks also chose what they judge."""

    mean: float
    error: float  # standard error of the mean
    episodes: int
    confirmed: bool

    @classmethod
    def of(cls, found: StoredEvaluation | StoredConfirmation) -> ValidationScore:
        """From what the journal holds."""
        return cls(found.mean, found.error, found.episodes, isinstance(found, StoredConfirmation))


@dataclass(frozen=True)
class ReportedMean:
    """A mean `(size,)`, as float32 bytes, with the generation that it is of and its score, if it has one."""

    run_uid: str
    settings: RunSettings
    generation: int
    vector: bytes
    judged: ValidationScore | None
    steps: int  # environment steps that the run had made by then

    def controller(self) -> Controller:
        """As it is saved."""
        judged = self.judged
        provenance = {
            "run_uid": self.run_uid,
            "generation": self.generation,
            "validation_mean": judged and judged.mean,
            "validation_error": judged and judged.error,
            "validation_episodes": judged and judged.episodes,
            "confirmed": judged is not None and judged.confirmed,
            "settings": asdict(self.settings),
            "steps": self.steps,
        }
        parameters = np.frombuffer(self.vector, dtype="<f4").astype(np.float32)
        spec = self.settings.task
        return Controller(
            self.settings.controller, parameters, spec.task, spec.bundle, provenance, spec.options, spec.version
        )


class ControllerWriter:
    """Follows a run's means and keeps the file at `path` up to date; `receipt` is drawn up as it is written."""

    def __init__(self, path: Path, run_uid: str, settings: RunSettings, receipt: Callable[[], RunProvenance]) -> None:
        self.current: ReportedMean | None = None  # `None` before the first generation is closed
        self._path = path
        self._run_uid = run_uid
        self._settings = settings
        self._receipt = receipt
        self._saved: ReportedMean | None = None
        self._due = False
        self._next = float("-inf")  # when a mean that was not evaluated may be written again

    def generation_closed(self, generation: int, mean: bytes, steps: int, now: float) -> None:
        """A generation was closed: its mean is reported, unless one was evaluated."""
        judged = self.current.judged if self.current is not None else None
        if self.current is not None and judged is not None:
            generation, mean = self.current.generation, self.current.vector
        self.current = ReportedMean(self._run_uid, self._settings, generation, mean, judged, steps)
        self._due = self._due or now >= self._next
        if self._due:
            self._next = now + SAVE_INTERVAL

    def set_judged(self, found: StoredEvaluation | StoredConfirmation, mean: bytes, steps: int) -> None:
        """A mean is the best of those that were evaluated, or was confirmed."""
        judged = ValidationScore.of(found)
        self.current = ReportedMean(self._run_uid, self._settings, found.generation, mean, judged, steps)
        self._due = True

    def finish(self) -> None:
        """The run ends: whatever is reported now is to be written."""
        self._due = True

    def save(self, *, at_once: bool = False) -> None:
        """Write the controller if it is due, or if it is not what the file holds and must be written `at_once`."""
        if self.current is None or self.current == self._saved or not (self._due or at_once):
            return
        controller = self.current.controller()
        told = {**controller.provenance, RECEIPT: to_dict(self._receipt())}
        try:
            replace(controller, provenance=told).save(self._path)
        except OSError as error:
            raise JournalError(
                f"cannot write {self._path}: {error.strerror}; make room and continue the run"
            ) from error
        self._saved, self._due = self.current, False

    @property
    def path(self) -> Path | None:
        """Where the reported controller lies; `None` before it was written."""
        return self._path if self._saved is not None else None
