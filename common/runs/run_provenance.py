"""The provenance of a controller: all that is needed to repeat its run.

A controller's file holds it as `receipt`, beside settings and score. Pages: export.md, determinism.md, results.md.
"""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import ControllerError
from dreamfleet.common.protocol.check_counts import CheckCounts
from dreamfleet.common.protocol.host_classes import HostClasses
from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.common.runs.effort import Effort
from dreamfleet.common.runs.records import RunSettings, StoredConfirmation, StoredEvaluation
from dreamfleet.common.runs.seeds import CONFIRMING_OFFSET, VALIDATION
from dreamfleet.common.schema.validation import OPTIONAL, Count, MalformedError, from_plain_lenient

RECEIPT = "receipt"  # key in a controller's provenance


@dataclass(frozen=True)
class StartProvenance:
    """The mean that a run started from, if not zero."""

    source: str
    sha256: str  # of the mean's little-endian doubles
    mean: str  # these bytes in base64
    effort: Effort | None = field(default=None, metadata=OPTIONAL)  # of the runs before it, if known

    @classmethod
    def of(cls, source: str, mean: str, effort: Effort | None) -> StartProvenance:
        """From a journal's values; `mean` is in base64."""
        return cls(source, hashlib.sha256(base64.b64decode(mean)).hexdigest(), mean, effort)

    @property
    def vector(self) -> NDArray[np.float64]:
        """The mean `(size,)`; `ControllerError` if its hash is wrong."""
        try:
            data = base64.b64decode(self.mean, validate=True)
            if hashlib.sha256(data).hexdigest() != self.sha256:
                raise ValueError("its hash is another")
            return np.frombuffer(data, dtype="<f8").astype(np.float64)
        except ValueError as error:
            raise ControllerError(f"the start in the controller's receipt is damaged: {error}") from error


@dataclass(frozen=True)
class RunProvenance:
    """The state of a run when it wrote its controller."""

    generations: Count  # closed ones
    effort: Effort  # of the run itself
    start: StartProvenance | None = field(default=None, metadata=OPTIONAL)  # `None`: zero
    fingerprint: str | None = field(default=None, metadata=OPTIONAL)  # of the first result's host
    # Whether hosts of several classes scored, or were allowed to: a repetition cannot be bit-identical.
    mixed: bool = field(default=False, metadata=OPTIONAL)
    versions: dict[str, str] | None = field(default=None, metadata=OPTIONAL)  # of the coordinator's packages
    # The first validation seed and the number of seeds, of an evaluation and of the confirmation.
    seeds: dict[str, tuple[int, ...]] | None = field(default=None, metadata=OPTIONAL)
    subspace: str | None = field(default=None, metadata=OPTIONAL)  # `Subspace.text`
    classes: HostClasses | None = field(default=None, metadata=OPTIONAL)  # of all results
    failed: Count = field(default=0, metadata=OPTIONAL)  # candidates that failed
    checks: CheckCounts | None = field(default=None, metadata=OPTIONAL)  # of results that other hosts scored again

    @property
    def total(self) -> Effort:
        """The effort of this run and of those before its start."""
        before = None if self.start is None else self.start.effort
        return self.effort if before is None else before + self.effort


def read_run_provenance(controller: Controller) -> RunProvenance:
    """Read the run provenance of a controller; `ControllerError` if it has none.

    For controllers of older versions it is derived from other fields, as if the run had ended with this mean.
    """
    provenance = controller.provenance
    try:
        if RECEIPT in provenance:
            return from_plain_lenient(RunProvenance, provenance[RECEIPT])
        task, steps = read_run_settings(controller).task.task, int(provenance["steps"])
        effort = Effort(dreamt=steps) if task == DREAM else Effort(driven=steps)
        return RunProvenance(int(provenance["generation"]) + 1, effort)
    except (KeyError, ValueError, TypeError, MalformedError) as error:
        raise ControllerError(f"the controller has no receipt of its run ({error}): it cannot be repeated") from error


def read_run_settings(controller: Controller) -> RunSettings:
    """Read the settings of a controller's run; `ControllerError` if it has none."""
    try:
        return from_plain_lenient(RunSettings, controller.provenance["settings"])
    except (KeyError, ValueError, TypeError, MalformedError) as error:
        raise ControllerError(f"the controller does not contain its run's settings ({error})") from error


def judged_facts(judged: StoredEvaluation | StoredConfirmation | None) -> dict[str, Any]:
    """What a controller's provenance says of its score; `None`: it has none."""
    return {
        "validation_mean": judged and judged.mean,
        "validation_error": judged and judged.error,
        "validation_episodes": judged and judged.episodes,
        "confirmed": isinstance(judged, StoredConfirmation),
    }


def validation_seed_ranges(settings: RunSettings) -> dict[str, tuple[int, ...]]:
    """The first validation seed and the number of seeds, of an evaluation and of the confirmation."""
    uses: dict[str, tuple[int, ...]] = {}
    if settings.evaluate_every:
        uses["evaluation"] = (VALIDATION.start, settings.evaluation_episodes)
    if settings.confirm_episodes:
        uses["confirmation"] = (VALIDATION.start + CONFIRMING_OFFSET, settings.confirm_episodes)
    return uses
