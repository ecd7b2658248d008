"""Finding controllers, world models and subspaces by the name of a file, a run, or a shipped artifact."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import (
    BundleStore,
    default_cache,
    find_bundle,
    pretrained_folder,
)
from dreamfleet.common.artifacts.controller import Controller, import_hint
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.errors import (
    BundleError,
    ConnectionFailedError,
    ControllerError,
    DreamfleetError,
    HandshakeRejectedError,
    JournalError,
    UsageError,
)
from dreamfleet.common.files.regular_files import is_file, is_folder, path_exists
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.printable import plural
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.common.runs.run_paths import BUNDLE, CONTROLLER, JOURNAL, resume_command, run_command, run_paths
from dreamfleet.common.runs.run_provenance import RECEIPT, judged_facts
from dreamfleet.common.schema.validation import to_plain

SUBSPACES = "subspaces"  # the folder of shipped subspaces: of a world model, by its name, or of a controller


def find_controller(name: str, runs_dir: Path) -> tuple[Controller, Path | None]:
    """The controller of this name, and the path beside it where a bundle may be."""
    path, run, shipped = Path(name), runs_dir / name, pretrained_folder() / f"{name}.npz"
    if is_file(path):
        return Controller.load(path), path.parent / BUNDLE
    for folder in (run, path):  # a run's name, or its folder
        if is_file(folder / CONTROLLER) and is_file(folder / JOURNAL):
            with RunFolder(folder) as stored:
                return load_controller_of(stored), folder / BUNDLE
        if is_file(folder / CONTROLLER):
            return Controller.load(folder / CONTROLLER), folder / BUNDLE
    if is_file(shipped):
        return Controller.load(shipped), None
    for folder in (run, path):
        if is_file(folder / JOURNAL):
            raise _no_controller_yet(folder.absolute())  # of which `.` has a name too
    if is_folder(path):
        raise ControllerError(f"{name} is a folder without {CONTROLLER}; {import_hint(path, '--out', 'OUT')}")
    names = ", ".join(sorted(each.stem for each in pretrained_folder().glob("*.npz"))) or "none"
    raise ControllerError(
        f"no controller {name!r}: no file, no run in {runs_dir.absolute()} (--runs-dir names another folder), and none "
        f"that ships: {names}"
    )


def load_controller_of(run: RunFolder) -> Controller:
    """The controller that a run reports; `ControllerError` before it has one, or if the file is another run's.

    Its file may lag behind the journal, as after a kill: the journal says which mean is reported, with which score.
    """
    if not path_exists(run.controller_path):
        raise _no_controller_yet(run.path)
    found = Controller.load(run.controller_path)
    if found.provenance.get("run_uid", run.uid) != run.uid:
        raise ControllerError(
            f"{run.controller_path} is not the controller of run {run.name}: it is written again when the run is "
            f"resumed: {resume_command(run.path)}"
        )
    with run.read_transaction():
        judged = run.reported()
        if judged is None:
            return found
        provenance = found.provenance | {"generation": judged.generation, **judged_facts(judged)}
        if isinstance(receipt := provenance.get(RECEIPT), dict):
            checks = {} if run.checks is None else {"checks": to_plain(run.checks)}
            kept = {name: value for name, value in receipt.items() if name != "checks"}
            provenance[RECEIPT] = kept | {"generations": len(run.history())} | checks
        return replace(found, parameters=run.evaluated_mean(judged.generation), provenance=provenance)


def _no_controller_yet(run: Path) -> ControllerError:
    return ControllerError(
        f"run {run.name} has no controller yet: it is written when the first generation closes, and again when "
        f"the run is resumed: {resume_command(run)}; a run of submitted batches has none"
    )


@contextmanager
def naming_the_stored_run(runs_dir: Path, name: str | None) -> Iterator[None]:
    """Where no coordinator answers for a run, the error also says how the run of this name on this disk stands."""
    try:
        yield
    except HandshakeRejectedError:
        raise
    except ConnectionFailedError as error:
        if more := _describe_stored(runs_dir, name):
            raise ConnectionFailedError(f"{error}; {more}") from error
        raise


def _describe_stored(runs_dir: Path, name: str | None) -> str:
    if name is None:
        count = len(list(run_paths(runs_dir)))
        listed = shell_command("runs", "list", "--runs-dir", runs_dir)
        return f"for the {plural(count, 'run')} on this disk: `{listed}`" if count else ""
    with suppress(DreamfleetError), open_run(runs_dir, name) as run:
        if run.ended:
            return f"run {name} on this disk has ended after {run.ended}: `{run_command(run.path, 'runs', 'show')}`"
        if run.state == "live":
            return f"run {name} on this disk is live: at another address, just starting, or closed to this join file"
        return f"run {name} on this disk was stopped or killed: `{resume_command(run.path)}`"
    return ""


def find_evaluated_mean(name: str, runs_dir: Path, generation: int) -> tuple[Controller, Path]:
    """The mean of a run's evaluated generation, and its bundle's path; `JournalError` lists the evaluated ones."""
    with open_run(runs_dir, name) as run:
        evaluated = [each.generation for each in run.evaluations()]
        if generation not in evaluated:
            known = ", ".join(map(str, evaluated)) or "none yet"
            raise JournalError(f"generation {generation} of run {name} was not evaluated; those that were: {known}")
        provenance = {"run_uid": run.uid, "generation": generation}
        return run.settings.controller_of(run.evaluated_mean(generation), provenance), run.bundle_path


def find_bundle_of(
    controller: Controller, named: str | None, beside: Path | None = None, remedy: str = "name it with --bundle FILE"
) -> Bundle | None:
    """The world model that a controller was evolved with: the `named` one, or one beside it, cached or shipped.

    `None` if its task needs none. `BundleError` with the `remedy` if it is missing.
    """
    if not controller.bundle:
        return None
    if named is not None:
        bundle = find_bundle(named)
    elif beside is not None and path_exists(beside):
        bundle = Bundle.open(beside, controller.bundle)
    else:
        found = BundleStore(default_cache()).find(controller.bundle)
        if found is None:
            raise BundleError(f"the controller's world model {controller.bundle[:12]}... is not here: {remedy}")
        bundle = found
    return bundle.for_controller(controller)


def find_subspace(name: str) -> Subspace:
    """A shipped subspace by name, or one by path; `UsageError` if there is none."""
    folder = pretrained_folder() / SUBSPACES  # docs/reference/optimisers.md names them
    shipped = folder / f"{name}.npz"
    if is_file(shipped):
        return Subspace.load(shipped)
    if not path_exists(Path(name)):
        names = ", ".join(sorted(each.stem for each in folder.glob("*.npz"))) or "none"
        raise UsageError(
            f"no subspace {name!r}: name a file of `dreamfleet lab subspace`, one that ships ({names}), or none for "
            "all parameters"
        )
    return Subspace.load(Path(name))
