"""The files that an iteration made: hashes, checks, and removal."""

import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from dreamfleet.common.artifacts.bundle import hash_file
from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.regular_files import is_file
from dreamfleet.common.host.processes import shell_command
from dreamfleet.experiments.iteration import plan
from dreamfleet.experiments.iteration.layout import ENCODED, EPISODES, IterationFolder
from dreamfleet.experiments.iteration.ledger import Artefact, FinishedPhase, IterationLedger
from dreamfleet.experiments.iteration.plan import Phase


def hash_artefacts(layout: IterationFolder, paths: Iterable[Path]) -> tuple[Artefact, ...]:
    """These files as the ledger names them; `DatasetError` if one is not there."""
    try:
        return tuple(Artefact(layout.relative(path), hash_file(path)) for path in paths)
    except OSError as error:
        raise DatasetError(f"{error.filename} was to be made and cannot be read: {error.strerror}") from error


def drive_files(layout: IterationFolder) -> list[Path]:
    """The drives of the data set, by number."""
    return sorted((layout.root / EPISODES).glob("[0-9]*.npz"))


def entries_to_check(ledger: IterationLedger) -> Iterator[FinishedPhase]:
    """The phases whose files are still needed: all drives, the model that counts, and the last two rounds."""
    last = max((each.round for each in ledger.entries), default=0)
    model = ledger.model_round(last - 1) if last > 1 else last
    for each in ledger.entries:
        if each.phase in plan.DATA or each.round >= last - 1 or each.round == model:
            yield each


def check(layout: IterationFolder, ledger: IterationLedger) -> None:
    """`DatasetError` for the first needed file that is missing or changed, with a remedy."""
    for entry in entries_to_check(ledger):
        for each in entry.made:
            if fault := _fault(layout, each):
                raise DatasetError(f"{layout.root / each.path} {fault}: {_remedy(layout, entry)}")


def _fault(layout: IterationFolder, found: Artefact) -> str:
    path = layout.root / found.path
    if not is_file(path):
        return "is missing"
    return "" if hash_file(path) == found.sha256 else "is not what was made"


def _remedy(layout: IterationFolder, entry: FinishedPhase) -> str:
    again = shell_command("iterate", "--data", layout.root, "--redo", entry.phase_key)
    return f"put it back from a copy, or have it made again, with all that followed: {again}"


def undo(layout: IterationFolder, ledger: IterationLedger, phases: Iterable[Phase]) -> IterationLedger:
    """Remove what these phases, the last ones, made or began; returns the ledger before them.

    Random drives that are whole stay: driven again they would be the same.
    """
    phases = tuple(phases)
    before = ledger.before(phases[0])
    if any(each.name in plan.DATA for each in phases):
        _undo_drives(layout, ledger, before, phases)
    for each in phases:
        for path in _outputs(layout, each):
            _remove(path)
    return before


def _undo_drives(
    layout: IterationFolder, ledger: IterationLedger, before: IterationLedger, phases: tuple[Phase, ...]
) -> None:
    random = [each for each in ledger.entries if each.phase_key in phases and each.phase == plan.COLLECT]
    whole = {drive.path for each in random for drive in each.made if not _fault(layout, drive)}
    for path in drive_files(layout):
        if layout.relative(path) not in before.files | whole:
            _remove(path)
            _remove(layout.root / ENCODED / path.name)


def _outputs(layout: IterationFolder, phase: Phase) -> list[Path]:
    """The paths in its round's folder that a phase makes, finished or not."""
    number, folder = phase.round, layout.round(phase.round)
    return {
        plan.INIT: [folder],
        plan.VAE: [*folder.glob("vae.*")],
        plan.MDNRNN: [*folder.glob("mdnrnn.*")],
        plan.BUNDLE: [layout.bundle(number)],
        plan.GATE: [layout.refitted(number), layout.gate_file(number)],
        plan.EVOLVE: [layout.run(number), layout.means(number), layout.start(number)],
    }.get(phase.name, [])


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
