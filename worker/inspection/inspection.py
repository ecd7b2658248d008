"""The whole look: from a bundle, a run or trainings to a folder of pictures and a page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.controller import Controller
from dreamfleet.common.errors import BundleError, DatasetError, JournalError, MissingExtraError, UsageError
from dreamfleet.common.files import is_file, write_aside
from dreamfleet.common.runs import RunFolder, open_run
from dreamfleet.common.stages import begun_stages, in_turn
from dreamfleet.common.store import find_bundle, shipped_names
from dreamfleet.worker.dream.daydream import can_dream
from dreamfleet.worker.inspection import curves, memory, vision
from dreamfleet.worker.inspection.eyes import CHECKPOINT, Eyes, held_out_drive
from dreamfleet.worker.inspection.own import own_pictures
from dreamfleet.worker.inspection.page import Page
from dreamfleet.worker.inspection.rollout import DriveConfig, EncodedRollout, drive
from dreamfleet.worker.inspection.section import Section
from dreamfleet.worker.inspection.tables import measured_rows
from dreamfleet.worker.inspection.trainings import MODELS, Training, trainings

PAGE = "index.html"
UNITS = {  # of figures of quality, by a part of their names, and what is good
    "picture_error": "summed squared error of the mean picture, which a reconstruction has to beat",
    "reconstruction_error": "summed squared error of a picture: the less, the better",
    "nats_per_dimension": "of the next latent: the less, the better",
    "latent_error": "root mean square, in the latents' spread: 0 is exact, 1 as bad as their mean",
    "auc": "0.5 is chance, 1 exact",
}
DRIVEN = ("episodes", "frames", "held_out_episodes")  # of a bundle's provenance


@dataclass(frozen=True)
class Subject:
    """What is looked at: a bundle; of a run, its controller too. A run without a world model shows how it went.

    With neither, trainings alone are looked at. `own` is the controller's world model, where that is another.
    """

    bundle: Bundle | None
    controller: Controller | None = None
    run: RunFolder | None = None
    own: Bundle | None = None


@contextmanager
def find_subject(name: str, runs_dir: Path) -> Iterator[Subject]:
    """A bundle by file or shipped name, else a run by name."""
    if is_file(Path(name)) or name in shipped_names():
        yield Subject(find_bundle(name))
        return
    try:
        run = open_run(runs_dir, name)
    except JournalError as error:
        shipped = ", ".join(shipped_names()) or "none"
        raise BundleError(f"no bundle {name!r} (a file, or one that ships: {shipped}), and {error}") from error
    with run:
        if not run.spec.bundle:
            yield Subject(None, run=run)
            return
        bundle = Bundle.open(run.bundle_path, run.spec.bundle)
        if not run.controller_path.exists():
            yield Subject(bundle, run=run)
            return
        controller = Controller.load(run.controller_path)
        yield Subject(bundle.fitting(controller), controller, run)


def inspect(
    subject: Subject, out: Path, config: DriveConfig, data: Sequence[Path] = (),
    on_section: Callable[[int, str], None] = lambda _done, _name: None, pictures: Sequence[Path] = (),
) -> Path:  # fmt: skip
    """Write a PNG a section and the page, with the trainings in the folders of `data`; returns the page's path.

    `pictures` are files of one's own, which the bundle's VAE looks at, else that of the first folder.
    """
    sections: list[Section] = []
    try:
        out.mkdir(parents=True, exist_ok=True)
        trained = trainings(data)
        for section in sections_of(subject, config, data, pictures, trained):
            sections.append(section)
            on_section(len(sections), section.name)
            if section.picture is not None:
                with write_aside(out / f"{section.name}.png") as file:
                    file.write(section.picture)
        with write_aside(out / PAGE) as file:
            file.write(_page(subject, trained, sections).html().encode(errors="replace"))
    except OSError as error:
        raise DatasetError(f"cannot write in {out}: {error.strerror}; choose another --out") from error
    return out / PAGE


def _page(subject: Subject, trained: Sequence[Training], sections: list[Section]) -> Page:
    told = [(f"{each.name}, {MODELS[each.model]}", each.told) for each in trained]
    if subject.bundle is not None:
        title = f"{subject.bundle.manifest.name}, a world model"
        about = f"{subject.bundle.path.name}, SHA-256 {subject.bundle.sha256}"
        return Page(title, about, facts(subject.bundle) + told, sections)
    if subject.run is None:
        names = ", ".join(dict.fromkeys(each.name for each in trained))
        return Page(f"How {names} learnt", f"trainings: {len(told)}", told, sections)
    settings, history = subject.run.settings, subject.run.history()
    stages = begun_stages(settings, history, subject.run.evaluations())
    rows = [
        ("task", settings.task.task),
        ("controller", f"{settings.controller.size} parameters, layers {settings.controller.layers}"),
        ("population", in_turn(f"{each.stage.population} x {each.stage.episodes} episodes" for each in stages)),
        ("generations", str(len(history))),
    ]
    return Page(f"{subject.run.name}, a run without a world model", f"run {subject.run.uid}", rows + told, sections)


def sections_of(
    subject: Subject, config: DriveConfig, data: Sequence[Path], pictures: Sequence[Path], trained: Sequence[Training]
) -> Iterator[Section]:
    """The sections of the page, each as it is drawn."""
    if pictures:
        yield own_pictures(_eyes(subject, data), pictures)
    if subject.bundle is not None:
        yield from _looks(subject.bundle, subject, config)
    else:
        yield from _vaes(data, config)
    yield from _fitness(subject)
    yield from curves.losses(trained)


def _eyes(subject: Subject, data: Sequence[Path]) -> Eyes:
    if subject.bundle is not None:
        return Eyes.of_bundle(subject.bundle)
    if not data:
        raise UsageError(
            "--picture is looked at by a VAE, and this run has none: name a bundle, or a training's --data"
        )
    return Eyes.of_folder(data[0])


def _vaes(data: Sequence[Path], config: DriveConfig) -> Iterator[Section]:
    """What VAEs keep that no bundle need hold yet: of one folder everything, of several the pictures of each."""
    folders = [each for each in data if (each / CHECKPOINT).exists() and any(each.glob("episodes/[0-9]*.npz"))]
    for number, folder in enumerate(folders, 1):
        try:
            eyes = Eyes.of_folder(folder)
        except MissingExtraError as error:
            yield Section("reconstructions", "What it sees, and what it keeps", f"Not shown: {error}")
            return
        driven = held_out_drive(folder, eyes, config)
        section = vision.reconstructions(driven, eyes)
        if len(folders) > 1:
            yield replace(section, name=f"{section.name}-{number}", title=f"{section.title}: {folder.resolve().name}")
            continue
        yield section
        yield from _latents(driven, eyes)


def _looks(bundle: Bundle, subject: Subject, config: DriveConfig) -> Iterator[Section]:
    driven, eyes = drive(bundle, subject.controller, config, subject.own), Eyes.of_bundle(bundle)
    yield vision.reconstructions(driven, eyes)
    yield from _latents(driven, eyes)
    yield from _dreams(bundle, driven, eyes)


def _latents(driven: EncodedRollout, eyes: Eyes) -> Iterator[Section]:
    yield vision.traversals(driven, eyes)
    yield vision.moments(driven)
    yield vision.samples(eyes)


def _fitness(subject: Subject) -> Iterator[Section]:
    if subject.run is not None and (evolved := curves.fitness(subject.run)):
        yield evolved


def _dreams(bundle: Bundle, driven: EncodedRollout, eyes: Eyes) -> Iterator[Section]:
    if not can_dream(bundle):
        text = "This bundle is from before dreams; build it again with `dreamfleet bundle` to see one."
        yield Section("dream", "A dream beside the drive", text)
        return
    yield memory.dream_beside(bundle, driven, eyes)
    if bundle.manifest.models.get("mdnrnn", {}).get("reward", "none") != "none":
        yield memory.rewards(bundle, driven)
    if looked := memory.attention(bundle, driven):
        yield looked


def _meant(name: str, value: object) -> str:
    """A figure of quality with its unit, and what is good."""
    return next((f"{value} ({unit})" for known, unit in UNITS.items() if known in name), str(value))


def facts(bundle: Bundle) -> list[tuple[str, str]]:
    """What the manifest tells: sizes, models, origin, and the figures of quality on held-out drives."""
    manifest, provenance = bundle.manifest, bundle.manifest.provenance
    model, quality = manifest.models.get("mdnrnn", {}), provenance.get("quality", {})
    rows = [
        ("pictures", " x ".join(str(size) for size in manifest.picture)),
        ("latents", str(manifest.latent)),
        ("hidden units", str(manifest.hidden)),
        ("reward head", str(model.get("reward", "not told"))),
        ("attention window", str(model.get("window", 0) or "none")),
        ("recorded states", str(bundle.recorded or "none")),
    ]
    rows += [
        (name, str(provenance[name])) for name in ("episodes", "frames", "held_out_episodes") if name in provenance
    ]
    if isinstance(quality, dict):
        rows += [(f"quality: {name}", _meant(name, value)) for name, value in quality.items()]
    measured = provenance.get("measured", [])
    rows += [row for told in measured for row in measured_rows(told)] if isinstance(measured, list) else []
    return [(name.replace("_", " "), value) for name, value in rows]
