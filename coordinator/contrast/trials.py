"""Doing a trial: its MDN-RNN trained, frozen and evolved in. Again after a kill, it goes on or ends the same."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.files import is_folder, is_there, read_text, write_aside
from dreamfleet.common.runs import JOURNAL, open_run
from dreamfleet.common.stopping import Stop
from dreamfleet.common.stored import best_of
from dreamfleet.coordinator.contrast.config import Contrast, Trial
from dreamfleet.coordinator.contrast.summary import Outcome
from dreamfleet.coordinator.iteration.evolving import Crew, evolve
from dreamfleet.coordinator.iteration.process import ask

# Of the data set. Not its preset: a kind is what its flags make of the preset tiny, whoever drove.
SHARED = ("episodes", "encoded", "vae.safetensors")
SETTINGS = "contrast.json"
LOCK = "contrast.lock"
MOST_BYTES = 1 << 20


class Trials:
    """All trials of a contrast in one folder, which nobody else works in."""

    def __init__(self, contrast: Contrast, data: Path, folder: Path, crew: Callable[[], Crew], stop: Stop) -> None:
        self._contrast, self._data, self._folder = contrast, data, folder
        self._crew, self._stop = crew, stop
        self._parameters: dict[Trial, int] = {}

    def begin(self) -> None:
        """Look whether data and settings fit, and keep the settings; what is wrong is said before hours go by."""
        for name in SHARED:
            if not is_there(self._data / name):
                raise DatasetError(f"{self._data} has no {name}: collect, train the VAE and encode there first")
        if not any((self._data / "encoded").iterdir()):
            raise DatasetError(f"{self._data} has no encoded drives: dreamfleet encode --data {self._data}")
        path = self._folder / SETTINGS
        begun, data = _read(path), str(self._data.resolve())
        if begun.get("data", data) != data:
            raise UsageError(f"{self._folder} was begun on {begun['data']}: begin in another --out")
        kept = self._contrast.after(begun)
        self._parameters = {trial: self._count(trial) for trial in self._contrast.trials}
        _write(path, {**kept, "data": data})

    def do(self, trial: Trial, before: Callable[[str], None]) -> Outcome:
        """Do what is left of it; `before` hears each part as it begins."""
        self._lay_out(trial)
        model = self._model(trial)
        if not is_there(model):
            before(f"{trial.name}: train mdnrnn")
            ask(self._training(trial), self._log(trial, "mdnrnn"), self._stop)
            before(f"{trial.name}: bundle")
            folder = str(self._of(trial))
            ask(("bundle", "--data", folder, "--out", str(model), "--json"), self._log(trial, "bundle"), self._stop)
        if not self._ended(trial):
            before(f"{trial.name}: evolve")
            crew = self._crew()
            evolve(self._run(trial, crew), trial.name, crew, self._of(trial) / "logs", self._stop)
        return self._outcome(trial)

    def _count(self, trial: Trial) -> int:
        """How many parameters its model learns; `UsageError` for flags that train no model."""
        self._lay_out(trial)
        words = (*self._training(trial), "--summary")
        return int(ask(words, self._log(trial, "summary"), self._stop)["parameters"])

    def _of(self, trial: Trial) -> Path:
        return self._folder / trial.name

    def _model(self, trial: Trial) -> Path:
        return self._of(trial) / f"{trial.name}.zip"

    def _log(self, trial: Trial, name: str) -> Path:
        return self._of(trial) / "logs" / f"{name}.log"

    def _lay_out(self, trial: Trial) -> None:
        """A data folder of its own for the verbs that train; it leads to the one data set."""
        folder = self._of(trial)
        folder.mkdir(parents=True, exist_ok=True)
        for name in SHARED:
            source = (self._data / name).resolve()
            if source.exists() and not is_there(folder / name):
                (folder / name).symlink_to(source, target_is_directory=is_folder(source))

    def _training(self, trial: Trial) -> tuple[str, ...]:
        return ("train", "mdnrnn", "--data", str(self._of(trial)), *self._contrast.training(trial), "--json")

    def _run(self, trial: Trial, crew: Crew) -> tuple[str, ...]:
        runs = self._folder / "runs"
        where = ("--runs-dir", str(runs), "--json", "--listen", *crew.listen)
        if is_there(runs / trial.name / JOURNAL):
            return ("coordinator", "--resume", trial.name, *where)
        model = ("--run", trial.name, "--bundle", str(self._model(trial)))
        return ("coordinator", *crew.coordinator, *self._contrast.evolution(trial), *model, *where)

    def _ended(self, trial: Trial) -> bool:
        runs = self._folder / "runs"
        if not is_there(runs / trial.name / JOURNAL):
            return False
        with open_run(runs, trial.name) as run:
            return run.ended is not None

    def _outcome(self, trial: Trial) -> Outcome:
        quality = Bundle.open(self._model(trial)).manifest.provenance.get("quality", {})
        figures = {name: float(value) for name, value in quality.items() if isinstance(value, (int, float))}
        of = Outcome(trial.kind, trial.seed, self._parameters[trial], figures)
        with open_run(self._folder / "runs", trial.name) as run:
            confirmed = run.confirmation()
            judged = confirmed or best_of(run.evaluations())
        if judged is None:
            return of
        told = {"score": judged.mean, "error": judged.error, "tracks": judged.episodes}
        return Outcome(**{**asdict(of), **told, "confirmed": confirmed is not None})


def _read(path: Path) -> dict[str, Any]:
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


def _write(path: Path, content: Any) -> None:
    try:
        with write_aside(path) as file:
            file.write((json.dumps(content, indent=1) + "\n").encode())
    except OSError as error:
        raise DatasetError(f"cannot write {path}: {error.strerror}; make room, or choose another --out") from error
