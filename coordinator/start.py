"""Where a new run may begin instead of at zero: a controller's parameters, or the mean of another run."""

from __future__ import annotations

import base64
import json
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import told
from dreamfleet.common.effort import START_EFFORT, Effort, start_effort
from dreamfleet.common.errors import ControllerError, DreamfleetError, JournalError
from dreamfleet.common.fields import written
from dreamfleet.common.files import is_file, is_there
from dreamfleet.common.messages import TaskSpec
from dreamfleet.common.receipt import receipt_of
from dreamfleet.common.runs import JOURNAL, RunFolder, open_run
from dreamfleet.common.shelf import find_controller
from dreamfleet.common.stored import RunSettings
from dreamfleet.common.subspace import Subspace
from dreamfleet.common.variants import Variant
from dreamfleet.coordinator.checkpoint import Checkpoint
from dreamfleet.coordinator.config import RunConfig
from dreamfleet.coordinator.journal import Journal

SOURCE, MEAN = "start", "start_mean"  # the facts' names
SUBSPACE = "subspace"


@dataclass(frozen=True)
class Start:
    """The first mean `(size,)`, and the world model it was evolved on; in the dream or in reality is all one."""

    mean: NDArray[np.float64]
    bundle: str  # SHA-256; empty: none
    source: str
    options: str = ""  # of the task, as its specification has them
    effort: Effort | None = None  # what was spent on it, where that is known

    def under(self, config: RunConfig) -> RunConfig:
        """The configuration with the options that this start was evolved under, where it does not name them.

        They are stronger than a preset's: parameters mean something in their own way of driving alone. What candidates
        pay is the start's only where nothing is named.
        """
        if self.bundle:
            own, said = Variant.of(self.options), {_name(text) for text in config.variant}
            kept = (text for text in (own.driving if said else own).texts if _name(text) not in said)
            return replace(config, variant=(*kept, *config.variant), preset_variant=())
        given = config.task_options is not None or config.environment or config.normalise
        return config if given else replace(config, task_options=self.options)

    @property
    def facts(self) -> dict[str, str]:
        """What the journal keeps of it, whole: the file that it came from may be gone when the run is continued."""
        mean = base64.b64encode(self.mean.astype("<f8").tobytes()).decode()
        spent = {} if self.effort is None else {START_EFFORT: json.dumps(written(self.effort))}
        return {SOURCE: self.source, MEAN: mean, **spent}

    def check(self, settings: RunSettings) -> None:
        """Refuse parameters that mean nothing to this world model, these options and this controller."""
        spec, shape = settings.task, settings.controller
        if self.bundle != spec.bundle:
            raise ControllerError(
                f"{self.source} belongs to {told(self.bundle)}, not to {told(spec.bundle)}: give its own --bundle, "
                "or fit it to this one by `dreamfleet refit`"
            )
        self._check_options(spec)
        if len(self.mean) != shape.size:
            raise ControllerError(
                f"{self.source} has {len(self.mean)} parameters, this run's controllers {shape.size}: give its own "
                "--controller, --hidden-units and --features"
            )
        if not (np.abs(self.mean) <= np.finfo(np.float32).max).all():
            raise ControllerError(f"{self.source} has parameters that no single-precision number can hold")

    def _check_options(self, spec: TaskSpec) -> None:
        """What candidates pay is no part of a controller: a start may be of another time cost."""
        if not spec.bundle and self.options != spec.options:
            raise ControllerError(
                f"{self.source} was evolved under other options of {spec.task}: leave --environment and --normalise "
                "out, and it brings its own"
            )
        if spec.bundle and (own := Variant.of(self.options).driving) != (wanted := Variant.of(spec.options).driving):
            raise ControllerError(
                f"{self.source} drives {_way(own)}, this run's controllers {_way(wanted)}, so that its parameters mean "
                "something else: leave --variant out, and it brings its own"
            )


def _name(text: str) -> str:
    """Of a NAME=VALUE."""
    return text.partition("=")[0]


def _way(variant: Variant) -> str:
    return f"with {variant.options}" if variant.options else "the plain way"


def find_start(name: str, runs_dir: Path) -> Start:
    """A controller's file, a run (its reported controller, or its mean while it is open), or what ships."""
    if not is_file(Path(name)) and is_there(runs_dir / name / JOURNAL):
        with open_run(runs_dir, name) as stored:
            if stored.ended is None:  # what it reports so far is an older mean than the one that it stands at
                return start_of(stored)
    controller, _ = find_controller(name, runs_dir)
    mean, effort = controller.parameters.astype(np.float64), None
    with suppress(ControllerError):  # a file may come from anywhere
        effort = receipt_of(controller).total
    return Start(mean, controller.bundle, f"controller {name}", controller.options, effort)


def start_of(stored: RunFolder) -> Start:
    """The mean of a run's latest generation."""
    mean, _ = latest(stored)
    return Start(mean, stored.spec.bundle, f"run {stored.name}", stored.spec.options, effort_of(stored))


def effort_of(stored: RunFolder) -> Effort:
    """What a run took so far, and what had been spent on its start."""
    return sum((each.effort for each in stored.efforts()), start_effort(stored.fact(START_EFFORT)) or Effort())


def latest(stored: RunFolder) -> tuple[NDArray[np.float64], float]:
    """Mean and step size of a run's latest generation, whichever optimiser wrote them."""
    state = stored.strategy_state()
    if state is None:
        raise DreamfleetError(f"run {stored.name} has no generation yet")
    head = Checkpoint.unpack(state).head
    return head.mean, head.sigma


def kept_start(journal: Journal) -> NDArray[np.float64] | None:
    """The mean `(size,)` that the journal says its run begins at; `None`: at zero.

    A journal from before it was kept has a first generation wherever it names a start, and goes on from that.
    """
    kept = journal.fact(MEAN)
    if kept is None:
        return None
    try:
        return np.frombuffer(base64.b64decode(kept, validate=True), dtype="<f8").astype(np.float64)
    except ValueError as error:
        raise JournalError(f"the start kept in {journal.path} is damaged: {error}; restore the folder") from error


def kept_subspace(kept: str | None, settings: RunSettings, where: Path) -> Subspace | None:
    """The subspace that a run's search keeps to, by the fact that is kept of it `where`; `None`: it has none."""
    if not settings.subspace:
        return None
    try:
        subspace = Subspace.of_text(kept or "")
        if subspace.sha256 != settings.subspace:
            raise ValueError("it is another one than the run's")
    except ValueError as error:
        raise JournalError(f"the subspace kept in {where} is damaged: {error}; restore the folder") from error
    return subspace
