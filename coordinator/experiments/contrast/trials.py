"""Doing a trial: its MDN-RNN trained, frozen and evolved in. Again after a kill, it goes on or ends the same."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.files.regular_files import is_folder, path_exists, read_text
from dreamfleet.common.host.stop_signals import Stop
from dreamfleet.common.runs.records import best_evaluation
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_paths import JOURNAL
from dreamfleet.coordinator.experiments.contrast.config import Contrast, Trial
from dreamfleet.coordinator.experiments.contrast.summary import TrialResult
from dreamfleet.coordinator.experiments.local_run import LocalFleet, evolve
from dreamfleet.coordinator.experiments.verb_process import run_for_json

# Of the data set. Not its preset: a kind is what its flags make of the preset tiny, whoever drove.
SHARED = ("episodes", "encoded", "vae.safetensors")
SETTINGS = "contrast.json"
LOCK = "contrast.lock"
MOST_BYTES = 1 << 20


class Trials:
    """All trials of a contrast in one folder, which nobody else works in."""

    def __init__(
        self, contrast: Contrast, data: Path, folder: Path, local_fleet: Callable[[], LocalFleet], stop: Stop
    ) -> None:
        self._contrast, self._data, self._folder = contrast, data, folder
        self._local_fleet, self._stop = local_fleet, stop
        self._parameters: dict[Trial, int] = {}

    def begin(self) -> None:
        """Look whether data and settings fit, and keep the settings; what is wrong is said before hours go by."""
        for name in SHARED:
            if not path_exists(self._data / name):
                raise DatasetError(f"{self._data} has no {name}: collect, train the VAE and encode there first")
        if not any((self._data / "encoded").iterdir()):
            raise DatasetError(f"{self._data} has no encoded drives: dreamfleet encode --data {self._data}")
        path = self._folder / SETTINGS
        begun, data = _read_settings(path), str(self._data.resolve())
        if begun.get("data", data) != data:
            raise UsageError(f"{self._folder} was begun on {begun['data']}: begin in another --out")
        kept = self._contrast.merge_settings(begun)
        self._parameters = {trial: self._count_parameters(trial) for trial in self._contrast.trials}
        _write_settings(path, {**kept, "data": data})

    def do(self, trial: Trial, on_step: Callable[[str], None]) -> TrialResult:
        """Do what is left of it; `on_step` is called as each part begins."""
        self._link_data(trial)
        model = self._model_path(trial)
        if not path_exists(model):
            on_step(f"{trial.name}: train mdnrnn")
            run_for_json(self._training_command(trial), self._log_path(trial, "mdnrnn"), self._stop)
            on_step(f"{trial.name}: bundle")
            folder = str(self._trial_folder(trial))
            run_for_json(
                ("bundle", "--data", folder, "--out", str(model), "--json"), self._log_path(trial, "bundle"), self._stop
            )
        if not self._ended(trial):
            on_step(f"{trial.name}: evolve")
            local_fleet = self._local_fleet()
            evolve(
                self._run_command(trial, local_fleet),
                trial.name,
                local_fleet,
                self._trial_folder(trial) / "logs",
                self._stop,
            )
        return self._outcome(trial)

    def _count_parameters(self, trial: Trial) -> int:
        """How many parameters its model learns; `UsageError` for flags that train no model."""
        self._link_data(trial)
        words = (*self._training_command(trial), "--summary")
        return int(run_for_json(words, self._log_path(trial, "summary"), self._stop)["parameters"])

    def _trial_folder(self, trial: Trial) -> Path:
        return self._folder / trial.name

    def _model_path(self, trial: Trial) -> Path:
        return self._trial_folder(trial) / f"{trial.name}.zip"

    def _log_path(self, trial: Trial, name: str) -> Path:
        return self._trial_folder(trial) / "logs" / f"{name}.log"

    def _link_data(self, trial: Trial) -> None:
        """A data folder of its own for the verbs that train; it leads to the one data set."""
        folder = self._trial_folder(trial)
        folder.mkdir(parents=True, exist_ok=True)
        for name in SHARED:
            source = (self._data / name).resolve()
            if source.exists() and not path_exists(folder / name):
                (folder / name).symlink_to(source, target_is_directory=is_folder(source))

    def _training_command(self, trial: Trial) -> tuple[str, ...]:
        return (
            "train",
            "mdnrnn",
            "--data",
            str(self._trial_folder(trial)),
            *self._contrast.training_flags(trial),
            "--json",
        )

    def _run_command(self, trial: Trial, local_fleet: LocalFleet) -> tuple[str, ...]:
        runs = self._folder / "runs"
        where = ("--runs-dir", str(runs), "--json", "--listen", *local_fleet.listen)
        if path_exists(runs / trial.name / JOURNAL):
            return ("coordinator", "--resume", trial.name, *where)
        model = ("--run", trial.name, "--bundle", str(self._model_path(trial)))
        return ("coordinator", *local_fleet.coordinator, *self._contrast.evolution_flags(trial), *model, *where)

    def _ended(self, trial: Trial) -> bool:
        runs = self._folder / "runs"
        if not path_exists(runs / trial.name / JOURNAL):
            return False
        with open_run(runs, trial.name) as run:
            return run.ended is not None

    def _outcome(self, trial: Trial) -> TrialResult:
        quality = Bundle.open(self._model_path(trial)).manifest.provenance.get("quality", {})
        figures = {name: float(value) for name, value in quality.items() if isinstance(value, (int, float))}
        of = TrialResult(trial.kind, trial.seed, self._parameters[trial], figures)
        with open_run(self._folder / "runs", trial.name) as run:
            confirmed = run.confirmation()
            judged = confirmed or best_evaluation(run.evaluations())
        if judged is None:
            return of
        told = {"score": judged.mean, "error": judged.error, "tracks": judged.episodes}
        return TrialResult(**{**asdict(of), **told, "confirmed": confirmed is not None})


def _read_settings(path: Path) -> dict[str, Any]:
    """What the folder was begun by; nothing if it is new."""
    try:
        found = json.loads(read_text(path, MOST_BYTES))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path} is damaged ({error}); put it back from a copy") from error
    if not isinstance(found, dict):
        raise DatasetError(f"{path} is damaged; put it back from a copy")
    return found


def _write_settings(path: Path, content: Any) -> None:
    try:
        with atomic_write(path) as file:
            file.write((json.dumps(content, indent=1) + "\n").encode())
    except OSError as error:
        raise DatasetError(f"cannot write {path}: {error.strerror}; make room, or choose another --out") from error
