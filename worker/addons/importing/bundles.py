"""World models of hardmaru/WorldModelsExperiments and of ctallec/world-models, as bundles."""

from dataclasses import replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle, write_bundle
from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.atomic_write import reporting_write_errors
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.worlds.shipped import WORLDS
from dreamfleet.worker.addons.importing import checkpoints
from dreamfleet.worker.addons.importing.json_weights import (
    ENDING_RNN,
    Weights,
    read_initial_latents,
    read_mdnrnn,
    read_vae,
)
from dreamfleet.worker.addons.importing.sources import MDRNN, PLACES, VAE, find_checkpoint, find_json
from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD, DataWorld
from dreamfleet.worker.tasks.recordable import Preprocessing
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.training.assemble import export_graphs, make_manifest  # needs the extra `train`
from dreamfleet.worker.training.data.dataset import find_world
from dreamfleet.worker.training.dream_facts import NO_DRIVES, describe_world
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig

WME = "hardmaru/WorldModelsExperiments"
ENDS_AT = "0.5"  # probability, in WME's dreams that end


@runtime_checkable
class TaskOfWME(Protocol):
    """Optional: a task in whose world that project has a program besides the first world's."""

    wme_options: str  # under which its world is as there


def import_json_model(folder: Path, out: Path) -> Bundle:
    """Write the bundle of a folder with `vae.json` and `rnn.json`, beside `initial_z.json` if it is there.

    Without that, dreams begin at a latent of zeros with deviation 1. `DatasetError` names what is missing or does not
    fit, `DreamfleetError` a file that cannot be written.
    """
    missing = [name for name in ("vae.json", "rnn.json") if find_json(folder, name) is None]
    if missing:
        raise DatasetError(f"{folder} lacks {' and '.join(' or '.join(PLACES[name]) for name in missing)}")
    paths = {name: found for name in PLACES if (found := find_json(folder, name)) is not None}
    rnn, layers = read_mdnrnn(paths["rnn.json"])
    config = VAEConfig(latent=layers.latent)
    vae, first = read_vae(paths["vae.json"], config), paths.get("initial_z.json")
    initial = read_initial_latents(first, config.latent) if first else np.zeros((1, 2, config.latent), np.float32)
    world = _find_ending_world() if layers == ENDING_RNN else OF_FIRST_WORLD
    return _write(out, WME, (vae, config), (rnn, layers), initial, world=world)


def _find_ending_world() -> DataWorld:
    """The world of WME's doomrnn, which says itself that it is: its name stands only in its room."""
    tasks = {name: find_task(name) for name in WORLDS}
    return next(DataWorld(name, task.wme_options) for name, task in tasks.items() if isinstance(task, TaskOfWME))


def import_checkpoints(folder: Path, out: Path) -> Bundle:
    """Write the bundle of a folder with `vae/best.tar` and `mdrnn/best.tar`.

    Dreams begin at a latent of zeros with deviation 1, as there. `DatasetError` names what is missing or does not fit.
    """
    seeing, remembering = find_checkpoint(folder, VAE), find_checkpoint(folder, MDRNN)
    if seeing is None or remembering is None:
        raise DatasetError(f"{folder} lacks {VAE if seeing is None else MDRNN}/best.tar: a bundle needs both")
    vae, rnn = checkpoints.read_vae(seeing), checkpoints.read_mdnrnn(remembering)
    latents, others = vae[1].latent, rnn[1].latent
    if latents != others:
        raise DatasetError(f"{seeing} has {latents} latents, {remembering} {others}: they do not belong together")
    initial = np.zeros((1, 2, latents), np.float32)
    return _write(out, checkpoints.SOURCE, vae, rnn, initial, find_world().preprocessings[checkpoints.PICTURES])


def _write(
    out: Path, source: str, vae: tuple[Weights, VAEConfig], rnn: tuple[Weights, MDNRNNConfig],
    initial: NDArray[np.float32], pictures: Preprocessing | None = None, world: DataWorld = OF_FIRST_WORLD,
) -> Bundle:  # fmt: skip
    provenance = {"imported": source, "versions": {"dreamfleet": package_version("dreamfleet")}}
    facts = describe_world(world, NO_DRIVES, rnn[1], end=ENDS_AT if rnn[1] == ENDING_RNN else None)
    manifest = make_manifest(out.stem, provenance, facts, vae[1], rnn[1], world, pictures)
    if rnn[1] == ENDING_RNN:  # controllers see the cells too, which follow the hidden state
        manifest = replace(manifest, hidden=2 * manifest.hidden)
    with reporting_write_errors(out):
        return write_bundle(out, manifest, export_graphs(vae[0], rnn[0], initial, vae[1], rnn[1], world))
