"""Where a new run may begin instead of at zero: a controller's parameters, or the mean of another run."""

import base64
import json
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import describe_bundle
from dreamfleet.common.artifacts.driving import Variant
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.errors import ControllerError, DreamfleetError, JournalError
from dreamfleet.common.files.regular_files import is_file, path_exists
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.common.runs.effort import START_EFFORT, Effort
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.common.runs.run_paths import JOURNAL
from dreamfleet.common.runs.run_provenance import read_run_provenance
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.coordinator.optimisers.checkpoint import Checkpoint
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.coordinator.storage.kept_revocations import REVOKED

START_SOURCE, START_MEAN = "start", "start_mean"  # the facts' names
SUBSPACE_FACT = "subspace"


@dataclass(frozen=True)
class StartPoint:
    """The first mean `(size,)`, and the world model it was evolved on; in the dream or in reality is all one."""

    mean: NDArray[np.float64]
    bundle: str  # SHA-256; empty: none
    source: str
    options: str = ""  # of the task, as its specification has them
    effort: Effort | None = None  # what was spent on it, where that is known
    revoked: str | None = None  # the fact of its run's revoked seats; docs/how-to/security.md

    def apply_to(self, config: RunConfig) -> RunConfig:
        """The configuration with the options that this start was evolved under, where it does not name them.

        They are stronger than a preset's: parameters mean something in their own way of driving alone. What candidates
        pay is the start's only where nothing is named, by a preset neither, and in the dream nothing.
        """
        if self.bundle:
            costs = tuple(text for text in config.preset_variant if _key_of(text) in Variant.COSTS)
            own, said = Variant.from_json(self.options), {_key_of(text) for text in (*costs, *config.variant)}
            way = own.without_costs if said or config.task == DREAM else own
            kept = (text for text in way.option_texts if _key_of(text) not in said)
            return replace(config, variant=(*kept, *config.variant), preset_variant=costs)
        given = config.task_options is not None or config.environment or config.observation or config.normalise
        return config if given else replace(config, task_options=self.options)

    @property
    def facts(self) -> dict[str, str]:
        """What the journal keeps of it, whole: the file that it came from may be gone when the run is continued."""
        mean = base64.b64encode(self.mean.astype("<f8").tobytes()).decode()
        spent = {} if self.effort is None else {START_EFFORT: json.dumps(to_plain(self.effort))}
        revoked = {} if self.revoked is None else {REVOKED: self.revoked}
        return {START_SOURCE: self.source, START_MEAN: mean, **spent, **revoked}

    def check(self, settings: RunSettings, bundle: Bundle | None) -> None:
        """Refuse parameters that mean nothing to this world model, these options and this controller."""
        spec, shape = settings.task, settings.controller
        if self.bundle not in (("",) if bundle is None else bundle.same_models):
            raise ControllerError(
                f"{self.source} belongs to {describe_bundle(self.bundle)}, not to {describe_bundle(spec.bundle)}: "
                "give its own --bundle, or fit it to this one by `dreamfleet lab refit`"
            )
        self._check_options(spec)
        if len(self.mean) != shape.size:
            raise ControllerError(
                f"{self.source} has {plural(len(self.mean), 'parameter')}, this run's controllers {shape.size}: "
                "give its own --controller, --hidden-units and --features"
            )
        if not (np.abs(self.mean) <= np.finfo(np.float32).max).all():
            raise ControllerError(f"{self.source} has parameters that no single-precision number can hold")

    def _check_options(self, spec: TaskSpec) -> None:
        """What candidates pay is no part of a controller: a start may be of another time cost."""
        if not spec.bundle and self.options != spec.options:
            raise ControllerError(
                f"{self.source} was evolved under other options of {spec.task}: omit --environment, --observation and "
                "--normalise, and it brings its own"
            )
        if spec.bundle and (own := Variant.from_json(self.options).without_costs) != (
            wanted := Variant.from_json(spec.options).without_costs
        ):
            raise ControllerError(
                f"{self.source} drives {_describe_variant(own)}, this run's controllers "
                f"{_describe_variant(wanted)}, so that its parameters mean something else: omit "
                "--variant, and it brings its own"
            )


def _key_of(text: str) -> str:
    return text.partition("=")[0]


def _describe_variant(variant: Variant) -> str:
    return f"with {variant.options}" if variant.options else "the plain way"


def find_start(name: str, runs_dir: Path) -> StartPoint:  # docs/reference/python.md
    """A controller's file, a run (its reported controller, or its mean while it is open), or what ships."""
    if not is_file(Path(name)) and path_exists(runs_dir / name / JOURNAL):
        with open_run(runs_dir, name) as stored, stored.verified_transaction():
            if stored.ended is None:  # what it reports so far is an older mean than the one that it stands at
                return start_from_run(stored)
    controller, _ = find_controller(name, runs_dir)
    mean, effort = controller.parameters.astype(np.float64), None
    with suppress(ControllerError):  # a file may come from anywhere
        effort = read_run_provenance(controller).total
    return StartPoint(mean, controller.bundle, f"controller {name}", controller.options, effort)


def start_from_run(stored: RunFolder) -> StartPoint:
    """The mean of a run's latest generation."""
    mean, _ = latest_mean_and_sigma(stored)
    return StartPoint(
        mean, stored.spec.bundle, f"run {stored.name}", stored.spec.options, stored.total_effort(),
        stored.fact(REVOKED),
    )  # fmt: skip


def latest_mean_and_sigma(stored: RunFolder) -> tuple[NDArray[np.float64], float]:
    """Mean and step size of a run's latest generation, whichever optimiser wrote them."""
    state = stored.strategy_state()
    if state is None:
        raise DreamfleetError(f"run {stored.name} has no generation yet")
    head = Checkpoint.unpack(state).head
    return head.mean, head.sigma


def stored_start_mean(journal: Journal) -> NDArray[np.float64] | None:
    """The mean `(size,)` that the journal says its run begins at; `None`: at zero."""
    kept = journal.fact(START_MEAN)
    if kept is None:
        return None
    try:
        return np.frombuffer(base64.b64decode(kept, validate=True), dtype="<f8").astype(np.float64)
    except ValueError as error:
        raise JournalError(f"the start kept in {journal.path} is damaged: {error}; restore the folder") from error


def stored_subspace(kept: str | None, settings: RunSettings, where: Path) -> Subspace | None:
    """The subspace that a run's search keeps to, by the fact that is kept of it `where`; `None`: it has none."""
    if not settings.subspace:
        return None
    try:
        subspace = Subspace.from_text(kept or "")
        if subspace.sha256 != settings.subspace:
            raise ValueError("it is another one than the run's")
    except ValueError as error:
        raise JournalError(f"the subspace kept in {where} is damaged: {error}; restore the folder") from error
    return subspace
