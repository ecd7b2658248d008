"""Run a phase: its stages, then its figures and files. A killed phase resumes to the same end."""

import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import SINGLE_PRECISION, WEIGHTS, Bundle
from dreamfleet.common.artifacts.bundle_store import describe_bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.files.regular_files import path_exists
from dreamfleet.common.host.stop_signals import Stop
from dreamfleet.common.runs.lookup import find_bundle_of, find_controller, load_controller_of
from dreamfleet.common.runs.records import StoredConfirmation, StoredEvaluation
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.common.runs.run_paths import BUNDLE as RUN_BUNDLE
from dreamfleet.experiments.iteration import artefacts, gate, plan
from dreamfleet.experiments.iteration.layout import ENCODED, EPISODES
from dreamfleet.experiments.iteration.plan import MDNRNN, VAE, Phase
from dreamfleet.experiments.iteration.requests import Requests
from dreamfleet.experiments.local.command_lines import Words
from dreamfleet.experiments.local.isolated import run_isolated
from dreamfleet.experiments.local.kept_document import write_document
from dreamfleet.experiments.local.local_run import LocalFleet, coordinator_words, evolve, has_ended
from dreamfleet.worker.addons.bundles.extract import ExtractRequest, extract_models
from dreamfleet.worker.addons.inspection.measure import measure
from dreamfleet.worker.addons.refit.stages import fit_subspace, refit_controller
from dreamfleet.worker.training.stages.bundle import build_bundle
from dreamfleet.worker.training.stages.collect import CollectReport, collect_drives, import_kept
from dreamfleet.worker.training.stages.encode import EncodeRequest, encode_drives
from dreamfleet.worker.training.stages.train import MODELS, Model, summarise, train_model

log = logging.getLogger("dreamfleet.coordinator.iterate")
Request = TypeVar("Request")
Report = TypeVar("Report")


@dataclass(frozen=True)
class PhaseResult:
    """What a phase asked for, its figures, and the files that it made."""

    requests: tuple[Any, ...] = ()
    figures: dict[str, Any] | None = None
    made: tuple[Path, ...] = ()


class PhaseRunner:
    """Runs phases of an iteration; `requests` knows what is finished, `on_line` gets each line that a stage prints."""

    def __init__(
        self, requests: Requests, local_fleet: Callable[[], LocalFleet], stop: Stop, on_line: Callable[[str], None]
    ) -> None:
        self._requests, self._local_fleet, self._stop, self._on_line = requests, local_fleet, stop, on_line
        self._layout, self._ledger, self._config = requests.layout, requests.ledger, requests.config

    def do(self, phase: Phase) -> PhaseResult:
        """Run a phase, or what is left of it."""
        number = phase.round
        self._link_data(number)
        asked = self._requests
        done: dict[str, Callable[[int], PhaseResult]] = {
            plan.COLLECT: lambda number: self._drives(number, plan.COLLECT, collect_drives, asked.collect(number)),
            plan.TAKE: lambda number: self._drives(number, plan.TAKE, import_kept, asked.import_kept(number)),
            plan.INIT: self._init, plan.DRIVE: self._drive, VAE: self._vae, plan.ENCODE: self._encode,
            MDNRNN: self._mdnrnn, plan.BUNDLE: self._bundle, plan.GATE: self._gate, plan.EVOLVE: self._evolve,
        }  # fmt: skip
        return done[phase.name](number)

    def _link_data(self, number: int) -> None:
        """Make the round's folder, with links to the one data set."""
        folder = self._layout.round(number)
        folder.mkdir(parents=True, exist_ok=True)
        for name in (EPISODES, ENCODED):
            (self._layout.root / name).mkdir(exist_ok=True)
            if not path_exists(folder / name):
                (folder / name).symlink_to(Path("..", "..", name), target_is_directory=True)

    def _call(self, number: int, name: str, stage: Callable[[Request, Stop], Report], request: Request) -> Report:
        return run_isolated(stage, request, self._layout.log(number, name), self._stop, self._on_line)

    def _init(self, number: int) -> PhaseResult:
        """Copy `--init`'s controller and world model, and write the checkpoints that training continues from."""
        layout = self._layout
        request = ExtractRequest(str(layout.bundle(number)), layout.round(number))
        controller, bundle = find_init(self._config.init, layout.runs)
        checkpoints = [layout.checkpoint(number, model) for model in (VAE, MDNRNN)]
        for path in checkpoints:  # of an attempt that was killed
            path.unlink(missing_ok=True)
        _copy(bundle.path, layout.bundle(number))
        self._call(number, plan.INIT, extract_models, request)
        for model in MODELS:
            self._call(number, plan.INIT, summarise, self._requests.train(1, model))
        controller.save(layout.optimum(number))
        pilots = self._save_pilots(controller, [controller.parameters], layout.means(number), layout.bundle(number))
        figures = {"sha256": bundle.sha256, "controller": self._config.init}
        return PhaseResult((request,), figures, (layout.bundle(number), *checkpoints, layout.optimum(number), *pilots))

    def _drive(self, number: int) -> PhaseResult:
        pilots = sorted(self._layout.means(number - 1).glob("[0-9]*.npz"))
        return self._drives(number, plan.DRIVE, collect_drives, self._requests.drive(pilots))

    def _drives(
        self, number: int, name: str, stage: Callable[[Request, Stop], CollectReport], request: Request
    ) -> PhaseResult:
        report, known = self._call(number, name, stage, request), self._ledger.files
        new = [path for path in artefacts.drive_files(self._layout) if self._layout.relative(path) not in known]
        return PhaseResult((request,), {"episodes": report.episodes, "new": len(new)}, tuple(new))

    def _vae(self, number: int) -> PhaseResult:
        if self._config.is_from_scratch(number) or self._config.vae != "keep":
            return self._train(number, VAE)
        before, path = (self._layout.checkpoint(each, VAE) for each in (self._ledger.model_round(number - 1), number))
        _copy(before, path)
        return PhaseResult(made=(path,))

    def _mdnrnn(self, number: int) -> PhaseResult:
        self._encode(number)  # only what is missing, damaged, or of another encoder
        return self._train(number, MDNRNN)

    def _train(self, number: int, model: Model) -> PhaseResult:
        request = self._requests.train(number, model)
        report = self._call(number, model, train_model, request)
        return PhaseResult((request,), report.facts, (self._layout.checkpoint(number, model),))

    def _encode(self, number: int) -> PhaseResult:
        request = EncodeRequest(self._layout.round(number))
        self._call(number, plan.ENCODE, encode_drives, request)
        return PhaseResult((request,))

    def _bundle(self, number: int) -> PhaseResult:
        self._encode(number)  # as before the training: recorded states need latents too
        request = self._requests.bundle(number)
        report = self._call(number, plan.BUNDLE, build_bundle, request)
        provenance = Bundle.open(report.bundle).manifest.provenance
        facts = {name: provenance[name] for name in ("frames", "quality")}
        return PhaseResult((request,), {"sha256": report.sha256, **facts}, (report.bundle,))

    def _gate(self, number: int) -> PhaseResult:
        refitted, gate_file = self._layout.refitted(number), self._layout.gate_file(number)
        asked, measured = self._requests.gate(number), dict[str, dict[str, tuple[Any, str]]]()
        fitting = (self._requests.refit(number, refitted),) if self._config.gate_losses else ()
        unfitted = self._try(number, "gate-refit", refit_controller, fitting[0])[1] if fitting else ""
        for side, requests in asked.items():
            measured[side] = {}
            for what, request in requests.items():
                measured[side][what] = None, unfitted
                if (side, what) != ("new", "losses") or not unfitted:
                    measured[side][what] = self._try(number, f"gate-{side}-{what}", measure, request)
        plain = {
            side: {what: report.facts if report else {"failed": why} for what, (report, why) in each.items()}
            for side, each in measured.items()
        }
        write_document(gate_file, plain, "--data")
        figures = {
            side: gate.figures({what: report and report.found[what] for what, (report, _) in each.items()})
            for side, each in measured.items()
        }
        verdict = gate.judge(figures["old"], figures["new"])
        known = {side: {name: each and asdict(each) for name, each in found.items()} for side, found in figures.items()}
        every = (request for each in asked.values() for request in each.values())
        made = (refitted, gate_file) if fitting and not unfitted else (gate_file,)
        return PhaseResult((*fitting, *every), {**known, **asdict(verdict)}, made)

    def _try(
        self, number: int, name: str, stage: Callable[[Request, Stop], Report], request: Request
    ) -> tuple[Report | None, str]:
        """A stage's report, or why it has none: drives may lose too few roads, or all at once."""
        try:
            return self._call(number, name, stage, request), ""
        except UsageError as error:
            return None, str(error)

    def _evolve(self, number: int) -> PhaseResult:
        layout, name, asked = self._layout, self._layout.run_name(number), tuple[Words, ...]()
        if not has_ended(layout.runs, name):
            fleet = self._local_fleet()
            log.info("run %s is reached at %s", name, ", ".join(fleet.listen))
            words = coordinator_words(name, layout.runs, fleet, lambda: self._run_flags(number))
            evolve(name, words, fleet, layout.round(number) / "logs", self._stop)
            asked = (words,)
        with open_run(layout.runs, name) as run:
            pilots, means = self._pilots(run, layout.means(number))
            figures = _describe_run(run)
        made = (layout.run(number) / RUN_BUNDLE, layout.optimum(number), *pilots)
        return PhaseResult(asked, {**figures, "means": means}, made)

    def _run_flags(self, number: int) -> Words:
        if not self._config.go_on or self._config.is_from_scratch(number):
            return self._requests.run_flags(number)
        start = self._layout.start(number)
        self._write_start(number, start)
        subspace = self._find_subspace(number) if self._config.subspace else None
        return self._requests.run_flags(number, start, subspace)

    def _find_subspace(self, number: int) -> Path | None:
        """The subspace that a round searches; None if its model predicts nothing of the last drives."""
        path = self._layout.subspace(number)
        try:
            self._call(number, "subspace", fit_subspace, self._requests.subspace(number, path))
        except UsageError as error:
            log.warning("round %d searches all parameters: %s", number, error)
            return None
        return path

    def _write_start(self, number: int, path: Path) -> None:
        """Write the last round's optimum as a controller of the world model that counts now."""
        layout = self._layout
        if self._ledger.model_round(number) == self._ledger.model_round(number - 1):
            shutil.copyfile(layout.optimum(number - 1), path)
        elif path_exists(layout.refitted(number)):
            shutil.copyfile(layout.refitted(number), path)
        else:
            self._call(number, "refit", refit_controller, self._requests.refit(number, path))

    def _pilots(self, run: RunFolder, folder: Path) -> tuple[list[Path], list[int]]:
        """Save the means that drive for the next round, beside a link to their world model; paths and generations."""
        reported = load_controller_of(run)
        generation = reported.provenance.get("generation")
        others = other_means(run.evaluations(), generation, self._config.means - 1)
        vectors = [reported.parameters, *(run.evaluated_mean(each) for each in others)]
        return self._save_pilots(reported, vectors, folder, run.bundle_path), [int(generation or 0), *others]

    def _save_pilots(
        self, like: Controller, vectors: Sequence[NDArray[np.float32]], folder: Path, bundle: Path
    ) -> list[Path]:
        """Save controllers with these parameters, beside a link to their world model in the same folder."""
        folder.mkdir(parents=True, exist_ok=True)
        if not path_exists(folder / RUN_BUNDLE):
            (folder / RUN_BUNDLE).symlink_to(Path("..", "..", "..", self._layout.relative(bundle)))
        paths = [folder / f"{row}.npz" for row in range(len(vectors))]
        for path, vector in zip(paths, vectors, strict=True):
            replace(like, parameters=vector, provenance={}).save(path)
        return paths


def find_init(name: str, runs_dir: Path) -> tuple[Controller, Bundle]:
    """The controller of `--init` and its world model; `DreamfleetError` if one is missing."""
    controller, beside = find_controller(name, runs_dir)
    bundle = find_bundle_of(controller, None, beside, f"put it beside {name}, as {RUN_BUNDLE}")
    if bundle is None:
        raise UsageError(f"controller {name} sees no world model, and an iteration needs one")
    if (whole := bundle.manifest.provenance.get(SINGLE_PRECISION)) and WEIGHTS not in bundle.manifest.parts:
        raise UsageError(
            f"the world model of {name} is rounded to eight bits, and no training goes on from it: give a controller "
            f"of {describe_bundle(str(whole))}, of which it was made"
        )
    return controller, bundle


def other_means(evaluations: Sequence[StoredEvaluation], reported: int | None, count: int) -> list[int]:
    """The generations of evaluated means beside the reported one's: the last, then the best; of equals the first.

    The last one is the dream's optimum: its drives teach the next model most, however it scored in reality.
    """
    last = max((each.generation for each in evaluations), default=None)
    others = [each for each in evaluations if each.generation != reported]
    others.sort(key=lambda each: (each.generation == last, each.rank), reverse=True)  # of equals the first stays so
    return [each.generation for each in others[:count]]


def _describe_run(run: RunFolder) -> dict[str, Any]:
    history, score = run.history(), None
    if (judged := run.reported()) is not None:
        word = Bundle.open(run.bundle_path, run.spec.bundle).manifest.world.score_word
        score = {"mean": judged.mean, "error": judged.error, "word": word, "generation": judged.generation,
                 "episodes": judged.episodes, "confirmed": isinstance(judged, StoredConfirmation)}  # fmt: skip
    steps = sum(each.steps for each in history)
    return {"run": run.name, "ended": run.ended, "generations": len(history), "steps": steps, "score": score}


def _copy(before: Path, path: Path) -> None:
    try:
        with before.open("rb") as source, atomic_write(path) as target:
            shutil.copyfileobj(source, target)
    except OSError as error:
        raise DatasetError(f"cannot write {path}: {error.strerror}; make room, or choose another --data") from error
