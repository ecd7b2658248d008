"""A contrast's trials: each trains an MDN-RNN, freezes it and evolves in it. A killed one resumes to the same end."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.cli.presets import default_run_preset
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.files.regular_files import is_folder, path_exists
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.host.stop_signals import Stop
from dreamfleet.common.runs.records import StoredConfirmation
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.schema.validation import from_plain, to_plain
from dreamfleet.experiments.contrast.config import Contrast, Trial
from dreamfleet.experiments.contrast.summary import TrialResult
from dreamfleet.experiments.local.command_lines import options
from dreamfleet.experiments.local.isolated import run_isolated
from dreamfleet.experiments.local.kept_document import read_document, write_document
from dreamfleet.experiments.local.kept_words import check_announced
from dreamfleet.experiments.local.local_run import LocalFleet, coordinator_words, evolve, has_ended, task_flags
from dreamfleet.experiments.pipeline import read_training
from dreamfleet.worker.training.stages.bundle import BundleRequest, build_bundle
from dreamfleet.worker.training.stages.train import TrainRequest, summarise, train_model

# Parts of the data set that trials link to. Its preset is none: a kind's flags change the preset of its world.
SHARED = ("episodes", "encoded", "vae.safetensors")
SETTINGS = "contrast.json"
LOCK = "contrast.lock"


@dataclass(frozen=True)
class StoredContrast:
    """The data set that a folder was begun on, its size then, and its trials."""

    data: str
    drives: int  # encoded ones
    contrast: Contrast


class Trials:
    """All trials of a contrast in one folder, which the caller has locked."""

    def __init__(
        self, contrast: Contrast, data: Path, folder: Path, local_fleet: Callable[[], LocalFleet], stop: Stop
    ) -> None:
        self._contrast, self._data, self._folder = contrast, data, folder
        self._local_fleet, self._stop = local_fleet, stop
        self._runs = folder / "runs"
        self._parameters: dict[Trial, int] = {}

    def begin(self) -> None:
        """Check data and settings before hours of work, and keep the settings."""
        for name in SHARED:
            if not path_exists(self._data / name):
                raise DatasetError(f"{self._data} has no {name}: collect, train the VAE and encode there first")
        drives = sum(1 for _ in (self._data / "encoded").iterdir())
        if not drives:
            raise DatasetError(f"{self._data} has no encoded drives: {shell_command('encode', '--data', self._data)}")
        path = self._folder / SETTINGS
        own = StoredContrast(str(self._data.resolve()), drives, self._contrast)
        begun = read_document(path, partial(from_plain, StoredContrast)) or own
        if begun.data != own.data:
            raise UsageError(f"{self._folder} was begun on {begun.data}: begin in another --out")
        if begun.drives != own.drives:
            raise UsageError(
                f"{self._folder} was begun when {begun.data} had {begun.drives} encoded drives, and now it has "
                f"{own.drives}: trials of other data do not compare, so begin in another --out"
            )
        kept = replace(own, contrast=self._contrast.continue_from(begun.contrast))
        for trial in self._contrast.trials:  # refuses wrong training flags
            self._link_data(trial)
            log = self._log_path(trial, "summary")
            self._parameters[trial] = run_isolated(summarise, self._training(trial), log, self._stop).parameters
        write_document(path, to_plain(kept), "--out")

    def do(self, trial: Trial, on_step: Callable[[str], None]) -> TrialResult:
        """Do what is left of a trial; `on_step` is called as each part begins."""
        self._link_data(trial)
        model = self._model_path(trial)
        if not path_exists(model):
            on_step(f"{trial.name}: train mdnrnn")
            run_isolated(train_model, self._training(trial), self._log_path(trial, "mdnrnn"), self._stop)
            on_step(f"{trial.name}: bundle")
            request = BundleRequest(self._trial_folder(trial), model)
            run_isolated(build_bundle, request, self._log_path(trial, "bundle"), self._stop)
        if not has_ended(self._runs, trial.name):
            fleet, world = self._local_fleet(), Bundle.open(model).manifest.task
            on_step(f"{trial.name}: evolve in the dream of {world}, from the preset {default_run_preset(world)}")
            check_announced([world])
            fleet = replace(fleet, worker=(*fleet.worker, *task_flags(world)))
            flags = (*self._contrast.run_flags_in(world), *options(bundle=model, seed=trial.seed))
            words = coordinator_words(trial.name, self._runs, fleet, lambda: flags)
            evolve(trial.name, words, fleet, self._trial_folder(trial) / "logs", self._stop)
        return self._outcome(trial)

    def _trial_folder(self, trial: Trial) -> Path:
        return self._folder / trial.name

    def _model_path(self, trial: Trial) -> Path:
        return self._trial_folder(trial) / f"{trial.name}.zip"

    def _log_path(self, trial: Trial, name: str) -> Path:
        return self._trial_folder(trial) / "logs" / f"{name}.log"

    def _link_data(self, trial: Trial) -> None:
        """Make the trial's own data folder, for the verbs that train, with links to the one data set."""
        folder = self._trial_folder(trial)
        folder.mkdir(parents=True, exist_ok=True)
        for name in SHARED:
            source = (self._data / name).resolve()
            if source.exists() and not path_exists(folder / name):
                (folder / name).symlink_to(source, target_is_directory=is_folder(source))

    def _training(self, trial: Trial) -> TrainRequest:
        flags = self._contrast.training_flags(trial)
        return read_training("mdnrnn", self._trial_folder(trial), trial.seed, *flags)

    def _outcome(self, trial: Trial) -> TrialResult:
        quality = Bundle.open(self._model_path(trial)).manifest.provenance.get("quality", {})
        figures = {name: float(value) for name, value in quality.items() if isinstance(value, (int, float))}
        trained = TrialResult(trial.kind, trial.seed, self._parameters[trial], figures)
        with open_run(self._runs, trial.name) as run:
            judged = run.reported()
        if judged is None:
            return trained
        is_confirmed = isinstance(judged, StoredConfirmation)
        return replace(trained, score=judged.mean, error=judged.error, tracks=judged.episodes, confirmed=is_confirmed)
