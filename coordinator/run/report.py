"""The controller that a run reports: never the luckiest sample.

While the run goes on, its best evaluated mean; that is provisional, for the best of many scores is in part luck. At the
end, the confirmed mean, with a score on which no choice was based. Without evaluations, the last mean.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import write_error
from dreamfleet.common.files.atomic_write import fsync_path
from dreamfleet.common.runs.records import RunSettings, StoredConfirmation, StoredEvaluation
from dreamfleet.common.runs.run_provenance import RECEIPT, RunProvenance, judged_facts
from dreamfleet.common.schema.validation import to_plain

SAVE_INTERVAL = 5.0  # seconds between two saves of means without evaluation: each waits for the disk


@dataclass(frozen=True)
class ReportedMean:
    """A mean `(size,)`, as float32 bytes, with its generation and its score on validation tracks, if it has one.

    Unless that is confirmed, the mean was also chosen by these tracks.
    """

    run_uid: str
    settings: RunSettings
    generation: int
    vector: bytes
    judged: StoredEvaluation | StoredConfirmation | None
    steps: int  # environment steps of the run by then

    def controller(self) -> Controller:
        """The controller to save."""
        provenance = {
            "run_uid": self.run_uid,
            "generation": self.generation,
            **judged_facts(self.judged),
            "settings": asdict(self.settings),
            "steps": self.steps,
        }
        parameters = np.frombuffer(self.vector, dtype="<f4").astype(np.float32)
        return self.settings.controller_of(parameters, provenance)


class ControllerWriter:  # docs/explanation/decisions.md
    """Keeps the reported controller in the file at `path`; `receipt` builds its provenance at each save."""

    def __init__(self, path: Path, run_uid: str, settings: RunSettings, receipt: Callable[[], RunProvenance]) -> None:
        self.current: ReportedMean | None = None  # `None` before the first generation is closed
        self._path = path
        self._run_uid = run_uid
        self._settings = settings
        self._receipt = receipt
        self._saved: ReportedMean | None = None
        self._due = False
        self._next = float("-inf")  # when a mean without evaluation may be saved again

    def generation_closed(self, generation: int, mean: bytes, steps: int, now: float) -> None:
        """Report a closed generation's mean, unless an evaluated mean is reported; an external run has none."""
        if self._settings.is_external:
            return
        if self.current is not None and self.current.judged is not None:
            self.current = replace(self.current, steps=steps)
        else:
            self.current = ReportedMean(self._run_uid, self._settings, generation, mean, None, steps)
        self._due = self._due or now >= self._next
        if self._due:
            self._next = now + SAVE_INTERVAL

    def set_judged(self, found: StoredEvaluation | StoredConfirmation, mean: bytes, steps: int) -> None:
        """Report the best evaluated mean, or the confirmed one."""
        self.current = ReportedMean(self._run_uid, self._settings, found.generation, mean, found, steps)
        self._due = True

    def finish(self) -> None:
        """The run ends: what it reports now must be saved, also if only the receipt has changed."""
        self._saved, self._due = None, True

    def save(self, *, at_once: bool = False) -> None:
        """Save the controller if it is due; with `at_once`, whenever the file holds another one."""
        if self.current is None or self.current == self._saved or not (self._due or at_once):
            return
        controller = self.current.controller()
        provenance = {**controller.provenance, RECEIPT: to_plain(self._receipt())}
        try:
            replace(controller, provenance=provenance).save(self._path)
        except OSError as error:
            raise write_error(self._path, error) from error
        self._saved, self._due = self.current, False

    def withdraw(self) -> None:
        """Remove the file, durably, before a recall is committed: the next incarnation writes it again."""
        withdraw_controller(self._path)
        self._saved = None


def withdraw_controller(path: Path) -> None:
    """Remove a run's reported controller, durably; `JournalError` where the disk refuses.

    This comes before what it follows from is taken back in the journal. So a kill in between leaves a run without the
    file, which its next incarnation writes again, and never a file that claims what counts no more.
    """
    try:
        path.unlink()
        fsync_path(path.parent)
    except FileNotFoundError:
        return
    except OSError as error:
        raise write_error(path, error) from error
