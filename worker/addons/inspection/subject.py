"""What is inspected, and who drives meanwhile: a controller, also one of another world model, or a random driver."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import find_bundle, shipped_names
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import BundleError, ControllerError, JournalError, UsageError
from dreamfleet.common.files.regular_files import is_file, path_exists
from dreamfleet.common.runs.lookup import find_bundle_of, find_controller, load_controller_of
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.worker.scoring.actors import Actor, ControllerActor, Floats
from dreamfleet.worker.tasks.api import Policy
from dreamfleet.worker.tasks.model_free_policies import ALL_DRIVERS, NO_PARAMETERS, DriverPolicy
from dreamfleet.worker.tasks.recordable import RecordableTask, TaskWithPolicies
from dreamfleet.worker.tasks.registry import task_of
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState


@dataclass(frozen=True)
class InspectionSubject:
    """What the page is about: a bundle, perhaps with a run and its controller, or a run without a world model.

    With none of them the page shows trainings alone. `own` is the controller's world model if it is another.
    """

    bundle: Bundle | None
    controller: Controller | None = None
    run: RunFolder | None = None
    own: Bundle | None = None


@contextmanager
def find_subject(name: str | None, runs_dir: Path) -> Iterator[InspectionSubject]:
    """Find a bundle by its file or shipped name, else a run by its name, which stays open; without a name nothing."""
    if not name:
        yield InspectionSubject(None)
        return
    if is_file(Path(name)) or name in shipped_names():
        yield InspectionSubject(find_bundle(name))
        return
    if Path(name).is_dir() and not path_exists(runs_dir / Path(name).name):
        raise UsageError(f"{name} is a folder and no run: if it holds data, give it by --data")
    try:
        run = open_run(runs_dir, name)
    except JournalError as error:
        shipped = ", ".join(shipped_names()) or "none"
        raise BundleError(f"no bundle {name!r} (a file, or one that ships: {shipped}), and {error}") from error
    with run:
        bundle = Bundle.open(run.bundle_path, run.spec.bundle) if run.spec.bundle else None
        if bundle is None or not run.controller_path.exists():
            yield InspectionSubject(bundle, run=run)
            return
        controller = load_controller_of(run)
        yield InspectionSubject(bundle.for_controller(controller), controller, run)


@dataclass(frozen=True)
class DriverChoice:
    """The driver: a controller with its own world model, or a random driver of the world by name."""

    controller: Controller | None = None
    own: Bundle | None = None
    driver: str = ""

    def observing_model(self, bundle: Bundle) -> Bundle:
        """The world model that observes the drives, set up for the controller if that was evolved with it."""
        if self.controller is None or self.controller.bundle != bundle.sha256:
            return bundle
        return bundle.for_controller(self.controller)

    def actors(self, bundle: Bundle, recurrent: RecurrentState) -> Callable[[int], Actor]:
        """Return a function from a drive's seed to its actor."""
        if self.controller is None or self.own is None:
            return make_driver_actors(bundle, self.driver)
        actor = make_controller_actor(self.controller, self.own, bundle, recurrent)
        return lambda _seed: actor

    def dream_controller(self, bundle: Bundle) -> Controller:
        """The controller, for dreams of the bundle; `UsageError` unless it was evolved with that world model."""
        if self.controller is None or self.controller.bundle != bundle.sha256:
            raise UsageError(
                "these dreams need a --controller that was evolved with this world model: it drives them; "
                "`dreamfleet lab refit CONTROLLER --to BUNDLE --data FOLDER` fits another one to it"
            )
        return self.controller


def choose_driver(
    subject: InspectionSubject, controller_name: str | None, runs_dir: Path
) -> tuple[Bundle, DriverChoice]:
    """The world model to look into, and the controller that drives: the named one, else the subject's own."""
    controller, own = subject.controller, subject.bundle
    if controller_name:
        controller, beside = find_controller(controller_name, runs_dir)
        if own is None or controller.bundle != own.sha256:
            own = find_bundle_of(controller, None, beside)
            if own is None:
                raise UsageError(
                    f"controller {controller_name} sees no world model: give one that was evolved with one"
                )
    bundle = subject.bundle or own
    if bundle is None:
        raise UsageError("give a bundle or a run to measure, or a --controller that has a world model")
    return bundle, DriverChoice(controller, own)


class DriverActor:
    """A policy without a recurrent state, for one drive."""

    recurrent_state = None

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        policy.begin(NO_PARAMETERS)

    def choose(self, seen: Any) -> Floats:
        """The policy's next action `(1, actions)`."""
        return np.asarray(self._policy.act(seen)[None])


def make_controller_actor(controller: Controller, own: Bundle, bundle: Bundle, watching: RecurrentState) -> Actor:
    """A controller of the world model `own`, while the world model `bundle` observes the drive by its state `watching`.

    The actor shares `watching` if both are the same world model. `ControllerError` unless both see the same pictures.
    """
    if own.sha256 == bundle.sha256:
        return ControllerActor(controller, bundle, watching)
    check_same_pictures(own, bundle)
    return ControllerActor(controller, own, RecurrentState(own.for_controller(controller)))


def check_same_pictures(own: Bundle, bundle: Bundle) -> None:
    """`ControllerError` unless the world models `own` and `bundle` see the same pictures of the same task."""
    if _pictures_of(own) != _pictures_of(bundle):
        raise ControllerError(
            f"the controller sees {own.manifest.preprocessing} of {own.manifest.task}, {bundle.manifest.name} "
            f"{bundle.manifest.preprocessing} of {bundle.manifest.task}: choose one that sees the same"
        )


def _pictures_of(bundle: Bundle) -> tuple[str, str, str]:
    manifest = bundle.manifest
    return manifest.task, manifest.world.options, manifest.preprocessing


def make_driver_actors(bundle: Bundle, name: str) -> Callable[[int], Actor]:
    """A function from a seed to an actor: the random driver or policy `name` of the bundle's task.

    The names are those of `dreamfleet collect --driver`; `UsageError` lists them for an unknown one.
    """
    task = task_of(bundle)
    drivers = list(task.drivers.items()) if isinstance(task, RecordableTask) else []
    policies = task.policies if isinstance(task, TaskWithPolicies) else {}
    known = (*((ALL_DRIVERS,) if drivers else ()), *dict(drivers), *policies)
    if name not in known:
        raise UsageError(
            f"task {bundle.manifest.task} has no driver {name!r}: choose one of {', '.join(known) or 'none'}, or a "
            "--controller"
        )

    def actor(seed: int) -> Actor:
        random = np.random.default_rng(seed)
        if name in policies:
            return DriverActor(policies[name](random))
        make = drivers[seed % len(drivers)][1] if name == ALL_DRIVERS else dict(drivers)[name]
        return DriverActor(DriverPolicy(make(random)))

    return actor
