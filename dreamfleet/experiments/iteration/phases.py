"""Run a phase: its verbs, then its figures and files. A killed phase resumes to the same end."""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import SINGLE_PRECISION, WEIGHTS, Bundle
from dreamfleet.common.artifacts.bundle_store import describe_bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.cli.model_commands import Model, Words
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.files.regular_files import path_exists
from dreamfleet.common.host.stop_signals import Stop
from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
from dreamfleet.common.runs.records import StoredEvaluation, best_evaluation
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.common.runs.run_paths import BUNDLE as RUN_BUNDLE
from dreamfleet.experiments.iteration import artefacts, gate
from dreamfleet.experiments.iteration.commands import Commands
from dreamfleet.experiments.iteration.layout import ENCODED, EPISODES
from dreamfleet.experiments.iteration.plan import (
    BUNDLE,
    COLLECT,
    DRIVE,
    ENCODE,
    EVOLVE,
    GATE,
    INIT,
    MDNRNN,
    TAKE,
    VAE,
    Phase,
)
from dreamfleet.experiments.local_run import LocalFleet, evolve, has_begun, has_ended

log = logging.getLogger("dreamfleet.coordinator.iterate")


@dataclass(frozen=True)
class PhaseResult:
    """The commands that a phase ran, its figures, and the files that it made."""

    commands: tuple[Words, ...] = ()
    figures: dict[str, Any] | None = None
    made: tuple[Path, ...] = ()


class PhaseRunner:
    """Runs phases of an iteration; `commands` knows what is finished."""

    def __init__(
        self, commands: Commands, local_fleet: Callable[[], LocalFleet], ask: Callable[[Words, Path], Any], stop: Stop
    ):
        """`ask` runs a verb to its end, logging to a path, and returns its JSON answer."""
        self._commands, self._local_fleet, self._ask, self._stop = commands, local_fleet, ask, stop
        self._layout, self._ledger, self._config = commands.layout, commands.ledger, commands.config

    def do(self, phase: Phase) -> PhaseResult:
        """Run a phase, or what is left of it."""
        number = phase.round
        self._link_data(number)
        done: dict[str, Callable[[int], PhaseResult]] = {
            INIT: self._init, COLLECT: self._collect, TAKE: self._import_kept, DRIVE: self._drive, VAE: self._vae,
            ENCODE: self._encode, MDNRNN: self._mdnrnn, BUNDLE: self._bundle, GATE: self._gate, EVOLVE: self._evolve,
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

    def _call(self, number: int, name: str, words: Words) -> Any:
        return self._ask(words, self._layout.log(number, name))

    def _init(self, number: int) -> PhaseResult:
        """Copy `--init`'s controller and world model, and write the checkpoints that training continues from."""
        layout, words = self._layout, self._commands.unbundle()
        controller, bundle = find_init(self._config.init, layout.runs)
        checkpoints = [layout.checkpoint(number, model) for model in (VAE, MDNRNN)]
        for path in checkpoints:  # of an attempt that was killed
            path.unlink(missing_ok=True)
        _copy(bundle.path, layout.bundle(number))
        self._call(number, INIT, words)
        for tried in self._commands.check_trainings():
            self._call(number, INIT, tried)
        controller.save(layout.optimum(number))
        pilots = self._save_pilots(controller, [controller.parameters], layout.means(number), layout.bundle(number))
        figures = {"sha256": bundle.sha256, "controller": self._config.init}
        return PhaseResult((words,), figures, (layout.bundle(number), *checkpoints, layout.optimum(number), *pilots))

    def _collect(self, number: int) -> PhaseResult:
        return self._drives(number, COLLECT, self._commands.collect(number))

    def _import_kept(self, number: int) -> PhaseResult:
        return self._drives(number, TAKE, self._commands.import_kept(number))

    def _drive(self, number: int) -> PhaseResult:
        pilots = sorted(self._layout.means(number - 1).glob("[0-9]*.npz"))
        return self._drives(number, DRIVE, self._commands.drive(pilots))

    def _drives(self, number: int, name: str, words: Words) -> PhaseResult:
        answer, known = self._call(number, name, words), self._ledger.files
        new = [path for path in artefacts.drive_files(self._layout) if self._layout.relative(path) not in known]
        return PhaseResult((words,), {"episodes": answer["episodes"], "new": len(new)}, tuple(new))

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
        words = self._commands.train(number, model)
        return PhaseResult((words,), self._call(number, model, words), (self._layout.checkpoint(number, model),))

    def _encode(self, number: int) -> PhaseResult:
        words = self._commands.encode(number)
        self._call(number, ENCODE, words)
        return PhaseResult((words,))

    def _bundle(self, number: int) -> PhaseResult:
        self._encode(number)  # as before the training: recorded states need latents too
        words = self._commands.bundle(number)
        answer = self._call(number, BUNDLE, words)
        provenance = Bundle.open(self._layout.bundle(number)).manifest.provenance
        facts = {name: provenance[name] for name in ("frames", "quality")}
        return PhaseResult((words,), {"sha256": answer["sha256"], **facts}, (self._layout.bundle(number),))

    def _gate(self, number: int) -> PhaseResult:
        refitted, gate_file = self._layout.refitted(number), self._layout.gate_file(number)
        commands = self._commands.gate(number)
        fitting = self._commands.refit(number, refitted) if self._config.gate_losses else ()
        unfitted = self._refit(number, fitting) if fitting else {}
        if unfitted:
            del commands["new"]["losses"]
        answers = {side: {what: self._measure(number, f"{side}-{what}", words) for what, words in each.items()}
                for side, each in commands.items()}  # fmt: skip
        if unfitted:
            answers["new"]["losses"] = unfitted
        _write_json(gate_file, answers)
        figures = {side: gate.figures(each) for side, each in answers.items()}
        verdict = gate.judge(figures["old"], figures["new"])
        plain = {side: {name: each and asdict(each) for name, each in found.items()} for side, found in figures.items()}
        words = tuple(words for each in commands.values() for words in each.values())
        made = (refitted, gate_file) if fitting and not unfitted else (gate_file,)
        return PhaseResult((fitting, *words) if fitting else words, {**plain, **asdict(verdict)}, made)

    def _refit(self, number: int, words: Words) -> dict[str, Any]:
        """Refit the last optimum to the new model; empty, or why that failed."""
        try:
            self._call(number, "gate-refit", words)
        except UsageError as error:
            return {"failed": str(error)}
        return {}

    def _measure(self, number: int, name: str, words: Words) -> dict[str, Any]:
        """The answer of `inspect`, or why it has none: drives may lose too few roads, or all at once."""
        try:
            return dict(self._call(number, f"gate-{name}", words))
        except UsageError as error:
            return {"failed": str(error)}

    def _evolve(self, number: int) -> PhaseResult:
        layout, name = self._layout, self._layout.run_name(number)
        words: tuple[Words, ...] = ()
        if not has_ended(layout.runs, name):
            local_fleet = self._local_fleet()
            log.info("run %s is reached at %s", name, ", ".join(local_fleet.listen))
            words = (self._run_command(number, local_fleet),)
            evolve(name, words[0], local_fleet, layout.round(number) / "logs", self._stop)
        with open_run(layout.runs, name) as run:
            pilots, means = self._pilots(run, layout.means(number))
            figures = _describe_run(run)
        made = (layout.run(number) / RUN_BUNDLE, layout.optimum(number), *pilots)
        return PhaseResult(words, {**figures, "means": means}, made)

    def _run_command(self, number: int, local_fleet: LocalFleet) -> Words:
        if has_begun(self._layout.runs, self._layout.run_name(number)):
            return self._commands.resume_run(number, local_fleet.listen, local_fleet.security)
        start, subspace = None, None
        if self._config.go_on and not self._config.is_from_scratch(number):
            start = self._layout.start(number)
            self._write_start(number, start)
            subspace = self._find_subspace(number) if self._config.subspace else None
        return self._commands.begin_run(
            number, local_fleet.listen, (*local_fleet.coordinator, *local_fleet.security), start, subspace
        )

    def _find_subspace(self, number: int) -> Path | None:
        """The subspace that a round searches; None if its model predicts nothing of the last drives."""
        path = self._layout.subspace(number)
        try:
            self._call(number, "subspace", self._commands.subspace(number, path))
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
            self._call(number, "refit", self._commands.refit(number, path))

    def _pilots(self, run: RunFolder, folder: Path) -> tuple[list[Path], list[int]]:
        """Save the means that drive for the next round, beside a link to their world model; paths and generations."""
        reported = Controller.load(run.controller_path)
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
    others.sort(key=lambda each: (each.generation != last, -each.mean, each.generation))
    return [each.generation for each in others[:count]]


def _describe_run(run: RunFolder) -> dict[str, Any]:
    history = run.history()
    steps = sum(each.steps for each in history)
    return {"run": run.name, "ended": run.ended, "generations": len(history), "steps": steps, "score": _score(run)}


def _score(run: RunFolder) -> dict[str, Any] | None:
    confirmed = run.confirmation()
    judged = confirmed or best_evaluation(run.evaluations())
    if judged is None:
        return None
    word = Bundle.open(run.bundle_path, run.spec.bundle).manifest.facts.score_word
    facts = {"generation": judged.generation, "episodes": judged.episodes, "confirmed": confirmed is not None}
    return {"mean": judged.mean, "error": judged.error, "word": word, **facts}


def _copy(before: Path, path: Path) -> None:
    try:
        with before.open("rb") as source, atomic_write(path) as target:
            shutil.copyfileobj(source, target)
    except OSError as error:
        raise DatasetError(f"cannot write {path}: {error.strerror}; make room, or choose another --data") from error


def _write_json(path: Path, content: Any) -> None:
    with atomic_write(path) as file:
        file.write(json.dumps(content, indent=1).encode())
