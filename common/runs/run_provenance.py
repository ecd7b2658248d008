"""The receipt of a controller: what it takes to have the run again that it came from.

It lies in the provenance of a controller's file, beside the run's settings and its score.
"""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import ControllerError
from dreamfleet.common.protocol.host_classes import HostClasses
from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.common.runs.effort import Effort
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.seeds import CONFIRMING_OFFSET, VALIDATION
from dreamfleet.common.serialization.constraints import Count
from dreamfleet.common.serialization.optional_fields import OPTIONAL, known
from dreamfleet.common.serialization.validation import MalformedError, from_plain

RECEIPT = "receipt"  # in a provenance


@dataclass(frozen=True)
class StartProvenance:
    """Where a run began instead of at zero."""

    source: str
    sha256: str  # of the mean's little-endian doubles
    mean: str  # these bytes, in base64
    effort: Effort | None = field(default=None, metadata=OPTIONAL)  # what had been spent on it, where that is known

    @classmethod
    def of(cls, source: str, mean: str, effort: Effort | None) -> StartProvenance:
        """As a journal keeps it."""
        return cls(source, hashlib.sha256(base64.b64decode(mean)).hexdigest(), mean, effort)

    @property
    def vector(self) -> NDArray[np.float64]:
        """The mean `(size,)`; `ControllerError` where it is not the one that was hashed."""
        try:
            data = base64.b64decode(self.mean, validate=True)
            if hashlib.sha256(data).hexdigest() != self.sha256:
                raise ValueError("its hash is another")
            return np.frombuffer(data, dtype="<f8").astype(np.float64)
        except ValueError as error:
            raise ControllerError(f"the start in the controller's receipt is damaged: {error}") from error


@dataclass(frozen=True)
class RunProvenance:
    """What a run was when it wrote its controller."""

    generations: Count  # that were closed
    effort: Effort  # of the run itself
    start: StartProvenance | None = field(default=None, metadata=OPTIONAL)  # `None`: at zero
    fingerprint: str | None = field(default=None, metadata=OPTIONAL)  # of the host that scored first
    # Hosts of other bits scored, or could: there is no second time to the bit.
    mixed: bool = field(default=False, metadata=OPTIONAL)
    versions: dict[str, str] | None = field(default=None, metadata=OPTIONAL)  # of what the coordinator computed with
    # The first validation seed, and how many, of each evaluation and of the confirmation.
    seeds: dict[str, tuple[int, ...]] | None = field(default=None, metadata=OPTIONAL)
    subspace: str | None = field(default=None, metadata=OPTIONAL)  # that the search kept to, whole, as a journal has it
    classes: HostClasses | None = field(default=None, metadata=OPTIONAL)  # of all hosts that scored

    @property
    def total(self) -> Effort:
        """With what had been spent on the start."""
        before = None if self.start is None else self.start.effort
        return self.effort if before is None else before + self.effort


def read_run_provenance(controller: Controller) -> RunProvenance:
    """The receipt of a controller; `ControllerError` where it has none.

    Of one from before there were receipts it is what follows from the rest, as if the run had ended with its mean.
    """
    told = controller.provenance
    try:
        if RECEIPT in told:
            return from_plain(RunProvenance, known(RunProvenance, told[RECEIPT]))
        task, steps = read_run_settings(controller).task.task, int(told["steps"])
        effort = Effort(dreamt=steps) if task == DREAM else Effort(driven=steps)
        return RunProvenance(int(told["generation"]) + 1, effort)
    except (KeyError, ValueError, TypeError, MalformedError) as error:
        raise ControllerError(f"the controller has no receipt of its run ({error}): it cannot be repeated") from error


def read_run_settings(controller: Controller) -> RunSettings:
    """The settings of the run that a controller came from; `ControllerError` where it names none."""
    try:
        return from_plain(RunSettings, known(RunSettings, controller.provenance["settings"]))
    except (KeyError, ValueError, TypeError, MalformedError) as error:
        raise ControllerError(f"the controller does not tell its run's settings ({error})") from error


def validation_seed_ranges(settings: RunSettings) -> dict[str, tuple[int, ...]]:
    """The first validation seed, and how many, of each evaluation and of the confirmation."""
    uses: dict[str, tuple[int, ...]] = {}
    if settings.evaluate_every:
        uses["evaluation"] = (VALIDATION.start, settings.evaluation_episodes)
    if settings.confirm_episodes:
        uses["confirmation"] = (VALIDATION.start + CONFIRMING_OFFSET, settings.confirm_episodes)
    return uses
