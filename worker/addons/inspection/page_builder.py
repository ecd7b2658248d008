"""Build an inspection page: from a bundle, a run or trainings to a folder of pictures and an HTML page."""

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.world_facts import DRAWN, EndRule
from dreamfleet.common.errors import DatasetError, MissingExtraError, UsageError
from dreamfleet.common.files.atomic_write import atomic_write, reporting_unwritable_folder
from dreamfleet.common.printable import plural
from dreamfleet.common.runs.stages import begun_stages, join_distinct
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.worker.addons.inspection import dreamt_spots, mdnrnn_sections, training_curves, vae_sections
from dreamfleet.worker.addons.inspection.encoded_rollout import DriveConfig, EncodedRollout, record_drive
from dreamfleet.worker.addons.inspection.page import Page, Section
from dreamfleet.worker.addons.inspection.subject import InspectionSubject
from dreamfleet.worker.addons.inspection.training_curves import MODELS, TrainingCurves, load_trainings
from dreamfleet.worker.addons.inspection.vae_sections import CHECKPOINT, VAEView, held_out_drives, own_pictures
from dreamfleet.worker.tasks.recordable import Preprocessing
from dreamfleet.worker.tasks.registry import task_of
from dreamfleet.worker.training.data.dataset import find_world, world_of_folder

PAGE = "index.html"
UNITS = {  # units of the quality figures, by a part of their names, and which values are good
    "picture_error": "summed squared error of the mean picture, which a reconstruction has to beat",
    "reconstruction_error": "summed squared error of a picture: the less, the better",
    "kept_of_spots": "share of spots of so many pixels, unlike the mean picture, that the decoder shows: 1 is all",
    "nats_per_dimension": "of the next latent: the less, the better",
    "latent_error": "root mean square, in the latents' spread: 0 is exact, 1 as bad as their mean",
    "auc": "0.5 is chance, 1 exact",
    "brier": "mean squared error of the probability of the end: the less, the better",
    "calibration": "mean probability of the end over the share of steps that ended: 1 is right",
}
MODEL = "mdnrnn.safetensors"  # of a data folder
DRIVEN = ("episodes", "frames", "held_out_episodes")  # counts in a bundle's provenance


def write_page(
    subject: InspectionSubject, out: Path, config: DriveConfig, data: Sequence[Path] = (),
    on_section: Callable[[int, Section], None] = lambda _done, _section: None, pictures: Sequence[Path] = (),
) -> Path:  # fmt: skip
    """Write a PNG per section and the page, with the trainings in the folders `data`; return the page's path.

    `pictures` are the user's own files, shown to the bundle's VAE, or without a bundle to that of the first folder.
    """
    sections: list[Section] = []
    with reporting_unwritable_folder(out, "choose another --out"):
        out.mkdir(parents=True, exist_ok=True)
        trained = load_trainings(data)
        for section in sections_of(subject, config, data, pictures, trained):
            sections.append(section)
            on_section(len(sections), section)
            if section.picture is not None:
                with atomic_write(out / f"{section.name}.png") as file:
                    file.write(section.picture)
        with atomic_write(out / PAGE) as file:
            file.write(_page(subject, trained, sections).html().encode(errors="replace"))
    return out / PAGE


def _page(subject: InspectionSubject, trained: Sequence[TrainingCurves], sections: list[Section]) -> Page:
    facts = [(f"{each.name}, {MODELS[each.model]}", each.summary) for each in trained]
    if subject.bundle is not None:
        title = f"{subject.bundle.manifest.name}, a world model"
        about = f"{subject.bundle.path.name}, SHA-256 {subject.bundle.sha256}"
        return Page(title, about, manifest_facts(subject.bundle) + facts, sections)
    if subject.run is None:
        names = ", ".join(dict.fromkeys(each.name for each in trained))
        return Page(f"How {names} learnt", f"trainings: {len(facts)}", facts, sections)
    settings, history = subject.run.settings, subject.run.history()
    stages = [each.stage.settings for each in begun_stages(settings, history, subject.run.evaluations())]
    rows = [
        ("task", settings.task.task),
        ("controller", f"{plural(settings.controller.size, 'parameter')}, layers {settings.controller.layers}"),
        ("population", join_distinct(f"{each.population} x {plural(each.episodes, 'episode')}" for each in stages)),
        ("generations", str(len(history))),
    ]
    return Page(f"{subject.run.name}, a run without a world model", f"run {subject.run.uid}", rows + facts, sections)


def sections_of(
    subject: InspectionSubject,
    config: DriveConfig,
    data: Sequence[Path],
    pictures: Sequence[Path],
    trained: Sequence[TrainingCurves],
) -> Iterator[Section]:
    """Yield the sections of the page one by one as they are drawn."""
    if pictures:
        yield own_pictures(_find_vae_view(subject, data), pictures, _preprocessings(subject, data))
    if subject.bundle is not None:
        yield from _bundle_sections(subject.bundle, subject, config)
    else:
        yield from _vae_sections(data, config)
    if subject.run is not None and (evolved := training_curves.fitness_section(subject.run)):
        yield evolved
    yield from training_curves.loss_sections(trained)


def _find_vae_view(subject: InspectionSubject, data: Sequence[Path]) -> VAEView:
    if subject.bundle is not None:
        return VAEView.of_bundle(subject.bundle)
    if not data:
        raise UsageError("--picture needs a VAE, and this run has none: name a bundle, or a training's --data")
    return VAEView.of_folder(data[0])


def _preprocessings(subject: InspectionSubject, data: Sequence[Path]) -> Collection[Preprocessing]:
    task = find_world(*world_of_folder(data[0])) if subject.bundle is None else task_of(subject.bundle)
    return tuple(getattr(task, "preprocessings", {}).values())


def _vae_sections(data: Sequence[Path], config: DriveConfig) -> Iterator[Section]:
    """Sections on VAEs in data folders: all sections for one folder, only reconstructions for several."""
    folders = [each for each in data if (each / CHECKPOINT).exists() and any(each.glob("episodes/[0-9]*.npz"))]
    for number, folder in enumerate(folders, 1):
        try:
            vae_view = VAEView.of_folder(folder)
        except MissingExtraError as error:
            yield Section("reconstructions", "What it sees, and what it keeps", f"Not shown: {error}")
            return
        driven = next(held_out_drives(folder, vae_view, config))
        section = vae_sections.reconstructions(driven, vae_view)
        if len(folders) > 1:
            yield replace(section, name=f"{section.name}-{number}", title=f"{section.title}: {folder.resolve().name}")
            continue
        yield section
        yield vae_sections.spots(driven, vae_view)
        yield from _latent_sections(driven, vae_view)
        if (folder / MODEL).exists() and (dreamt := _dreamt_spots_of_folder(folder, vae_view, config)):
            yield dreamt


def _dreamt_spots_of_folder(folder: Path, vae_view: VAEView, config: DriveConfig) -> Section | None:
    from dreamfleet.worker.training.assemble import assemble

    with TemporaryDirectory() as aside:
        try:
            bundle = assemble(folder, Path(aside) / "data.zip", "data", with_weights=False)
        except DatasetError as error:
            return Section(dreamt_spots.NAME, dreamt_spots.TITLE, f"Not shown: {error}")
        return dreamt_spots.dreamt_spots_section(bundle, held_out_drives(folder, vae_view, config))


def _bundle_sections(bundle: Bundle, subject: InspectionSubject, config: DriveConfig) -> Iterator[Section]:
    driven, vae_view = record_drive(bundle, subject.controller, config, subject.own), VAEView.of_bundle(bundle)
    yield vae_sections.reconstructions(driven, vae_view)
    yield vae_sections.spots(driven, vae_view)
    yield from _latent_sections(driven, vae_view)
    yield mdnrnn_sections.dream_section(bundle, driven, vae_view)
    if dreamt := dreamt_spots.dreamt_spots_section(bundle, _drives(bundle, subject, config, driven)):
        yield dreamt
    heads = bundle.manifest.models.get("mdnrnn", {})
    if heads.get("reward", "none") != "none":
        yield mdnrnn_sections.reward_section(bundle, driven)
    if heads.get("done"):
        yield mdnrnn_sections.ends_section(bundle, driven)
    if looked := mdnrnn_sections.attention_section(bundle, driven):
        yield looked


def _drives(
    bundle: Bundle, subject: InspectionSubject, config: DriveConfig, first: EncodedRollout
) -> Iterator[EncodedRollout]:
    """The page's drive, and after it those of the seeds that follow, unless they are too short for a dream."""
    yield first
    for seed in count(config.seed + 1) if config.steps > dreamt_spots.AHEAD[-1] else ():
        yield record_drive(bundle, subject.controller, replace(config, seed=seed), subject.own)


def _latent_sections(driven: EncodedRollout, vae_view: VAEView) -> Iterator[Section]:
    yield vae_sections.traversals(driven, vae_view)
    yield vae_sections.latent_moments(driven)
    yield vae_sections.samples(vae_view)


def _end_text(end: EndRule) -> str:
    weighted = f", its odds divided by {end.odds_weight:g}" if end.odds_weight != 1 else ""
    if end.kind == DRAWN:
        return f"as often as it predicts{weighted}"
    return f"where an end is likelier than {end.at:g}"


def manifest_facts(bundle: Bundle) -> list[tuple[str, str]]:
    """The facts in a bundle's manifest: sizes, models, origin, and quality figures on held-out drives."""
    manifest, provenance = bundle.manifest, bundle.manifest.provenance
    model, quality = manifest.models.get("mdnrnn", {}), provenance.get("quality", {})
    rows = [
        ("task", manifest.task),
        ("pictures", " x ".join(str(size) for size in manifest.picture)),
        ("latents", str(manifest.latent)),
        ("hidden units", str(manifest.hidden)),
        ("reward head", str(model.get("reward", "unknown"))),
        ("attention window", str(model.get("window", 0) or "none")),
        ("recorded states", str(bundle.recorded_count or "none")),
    ]
    facts, reward = manifest.world, manifest.world.reward
    cost = f" - {reward.cost:g}" if reward.cost else ""
    rows += [("options", facts.options or "none"), ("reward of a dream", f"{reward.gain:g} x {reward.source}{cost}")]
    rows += [("a dream ends", _end_text(facts.end))]
    rows += [(name, str(provenance[name])) for name in DRIVEN if name in provenance]
    for name, value in quality.items() if isinstance(quality, dict) else ():
        unit = next((f" ({unit})" for known, unit in UNITS.items() if known in name), "")
        rows.append((f"quality: {name}", f"{value}{unit}"))
    measured = provenance.get("measured", [])
    rows += [row for each in measured for row in _measured_rows(each)] if isinstance(measured, list) else []
    return [(name.replace("_", " "), value) for name, value in rows]


def _measured_rows(measured: Any) -> Iterator[tuple[str, str]]:
    """Yield a row for each main figure in a manifest's `measured`; malformed entries are left out."""
    with suppress(KeyError, TypeError, ValueError, AttributeError, OverflowError):
        for each in measured.get("probe", {}).get("known", ()):
            yield f"R² of {each['quantity']}, linear on [z, h]", _estimate(each["found"]["zh_linear"])
        for each in measured.get("losses", {}).get("begun", ()):
            yield f"road lost in dreams begun {each['begun']}", _estimate(each["figures"]["lost"]["dream"])
        for each in measured.get("survival", {}).get("policies", ()):
            yield f"lives in dreams, of its real life: {each['policy']}", _estimate(each["ratio"])
        for each in measured.get("likeness", {}).get("quantities", ()):
            yield f"dreamt share of {each['quantity']} above {each['rare']:.3g}", _estimate(each["found"]["dream"])


def _estimate(figure: dict[str, Any]) -> str:
    return format_with_error(figure["value"], figure["error"], 2)
