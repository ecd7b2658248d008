"""Re-run a run from the provenance in its controller. Pages: determinism.md, export.md, results.md."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.cli.config import Table
from dreamfleet.common.errors import ControllerError, UsageError
from dreamfleet.common.files.regular_files import path_exists
from dreamfleet.common.protocol.host_classes import BY_FINGERPRINT
from dreamfleet.common.runs.lookup import load_controller_of
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.common.runs.run_paths import JOURNAL
from dreamfleet.common.runs.run_provenance import RunProvenance, read_run_provenance, read_run_settings
from dreamfleet.coordinator.settings.config import RunConfig, config_values
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.resume_settings import stored_network
from dreamfleet.coordinator.settings.run_provenance import versions
from dreamfleet.coordinator.settings.start import START_MEAN, StartPoint


@dataclass(frozen=True)
class RerunComparison:
    """What the run reported the second time, beside the first."""

    same: bool  # to the bit
    summary: str
    why: str = ""  # what differs, and may be the cause


@dataclass(frozen=True)
class Rerun:
    """What it takes to have a controller's run again."""

    controller: Controller
    bundle: Bundle | None
    settings: RunSettings
    receipt: RunProvenance

    @classmethod
    def of(cls, controller: Controller, bundle: Bundle | None) -> Rerun:
        """By the controller's receipt; `ControllerError` where it has none, or its run closed no generation."""
        found = cls(controller, bundle, read_run_settings(controller), read_run_provenance(controller))
        if found.receipt.generations < 1:
            raise ControllerError("the controller's run closed no generation: there is nothing to repeat")
        return found

    @property
    def limits(self) -> LimitsConfig:
        """As many generations as were closed, whatever ended the run the first time."""
        return LimitsConfig(generations=self.receipt.generations)

    @property
    def expected_difference(self) -> str:
        """Why it is known beforehand that the bits may be others; empty: nothing speaks against equal ones."""
        if self.receipt.mixed or (self.receipt.classes is not None and self.receipt.classes.mixed):
            return "hosts of several classes scored the first run: expect another controller"
        if self.receipt.classes is not None and self.receipt.classes.varying:
            return "the first run's environment is not deterministic: expect another controller"
        if self.receipt.fingerprint is None:
            return "the receipt does not name the first run's hosts: the controller may differ in its last bits"
        return ""

    @property
    def start(self) -> StartPoint | None:
        """Where the run began, whole."""
        kept, spec = self.receipt.start, self.settings.task
        return None if kept is None else StartPoint(kept.vector, spec.bundle, kept.source, spec.options, kept.effort)

    @property
    def _subspace(self) -> Subspace | None:
        """What the search kept to; `ControllerError` where the receipt holds another one than the settings name."""
        try:
            kept, wanted = self.receipt.subspace, self.settings.subspace
            found = Subspace.from_text(kept) if kept is not None else None
            if (found.sha256 if found else "") != wanted:
                raise ValueError("it is not the one that the settings name")
            return found
        except ValueError as error:
            raise ControllerError(f"the subspace in the controller's receipt is damaged: {error}") from error

    def plan(self, folder: Path) -> tuple[RunConfig | None, Table]:
        """How to begin the run in a folder, or `None` and the network it had, where it was begun there before.

        `UsageError` where another run lies there, such as the first one itself, or this version would begin another.
        """
        if not path_exists(folder / JOURNAL):
            return self._config(), {"failure_limit": 1.0}  # the first run went on, whatever failed
        start = self.receipt.start and self.receipt.start.mean
        with open_run(folder.parent, folder.name) as stored:
            if stored.uid and stored.uid == self.controller.provenance.get("run_uid"):
                raise UsageError(
                    f"run {folder.name} is the one that the controller came from, compared with itself: "
                    "choose another --run"
                )
            if stored.settings != self.settings or stored.fact(START_MEAN) != start:
                raise UsageError(f"run {folder.name} exists and is another run: choose another --run")
            return None, stored_network(stored)

    def compare(self, folder: Path) -> RerunComparison:
        """What the run in a folder reports, with the controller."""
        with RunFolder(folder) as stored:
            again = load_controller_of(stored)
            why, hosts = self._describe_difference(stored), self._describe_hosts(stored)
        if again.sha256 == self.controller.sha256:
            return RerunComparison(
                True, f"the same controller as the first time, bit-identical ({again.sha256[:12]}){hosts}"
            )
        names = f"({again.sha256[:12]} instead of {self.controller.sha256[:12]})"
        return RerunComparison(False, f"NOT the same controller as the first time {names}: {why}", why)

    def _config(self) -> RunConfig:
        path = self.bundle.path if self.bundle is not None else Path()
        config = replace(RunConfig(**config_values(self.settings, path)), loaded_subspace=self._subspace)
        made = freeze(config, self.bundle)
        others = [each.name for each in fields(made) if getattr(made, each.name) != getattr(self.settings, each.name)]
        if others:
            raise UsageError(
                f"this version would begin another run than the receipt's ({', '.join(others)} would differ): install "
                f"dreamfleet {(self.receipt.versions or {}).get('dreamfleet', 'as it was')}"
            )
        return config

    def _both_classes(self, stored: RunFolder) -> tuple[str, str] | None:
        """The one class of the hosts of the first time, and of this time; `None` if either is unknown or mixed."""
        classes = [each.largest[0].host_class for each in (self.receipt.classes, stored.classes)
                if each is not None and each.total == 1]  # fmt: skip
        if len(classes) < 2 or any(each.startswith(BY_FINGERPRINT) for each in classes):
            return None
        return classes[0], classes[1]

    def _describe_hosts(self, stored: RunFolder) -> str:
        """Whether its hosts are of the first time's class, as far as that is known; a part of a sentence."""
        if (classes := self._both_classes(stored)) is None:
            return ""
        return ", on hosts of the same class" if classes[0] == classes[1] else ", though on hosts of another class"

    def _describe_difference(self, stored: RunFolder) -> str:
        """What is known to differ between the first time and now."""
        first, here = self.receipt, versions()
        if first.mixed:
            return "hosts of several classes scored the first run, so no other run is bit-identical"
        if stored.classes.varying:
            return "the environment is not deterministic, so no two runs are bit-identical"
        if stored.classes.mixed:
            return f"this time hosts of several classes scored ({stored.classes.description}): --strict keeps to one"
        if (classes := self._both_classes(stored)) and classes[0] != classes[1]:
            return f"its hosts were of class {classes[0]}, and these are of class {classes[1]}: their bits differ"
        if first.fingerprint is None:
            return "the receipt does not name the first run's hosts, and only equal hosts give equal bits"
        if not classes and first.fingerprint != stored.fingerprint:
            return f"its hosts had another fingerprint: [{first.fingerprint}], now [{stored.fingerprint}]"
        others = [f"{name} {each}, now {here.get(name)}" for name, each in (first.versions or {}).items()
                  if here.get(name) != each]  # fmt: skip
        return f"the coordinator's versions differ: {'; '.join(others)}" if others else "hosts and versions are equal"
