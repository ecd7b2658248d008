"""World models of hardmaru/WorldModelsExperiments, carracing, and of ctallec/world-models, as bundles."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle, write_bundle
from dreamfleet.common.errors import DatasetError
from dreamfleet.common.host.packages import package_version
from dreamfleet.worker.addons.importing import checkpoints
from dreamfleet.worker.addons.importing.json_weights import Weights, read_initial_latents, read_mdnrnn, read_vae
from dreamfleet.worker.addons.importing.sources import MDRNN, PLACES, VAE, find_checkpoint, find_json
from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD
from dreamfleet.worker.tasks.recordable import Preprocessing
from dreamfleet.worker.training.assemble import export_graphs, make_manifest  # needs the extra `train`
from dreamfleet.worker.training.data.data_folder import explain_write_errors
from dreamfleet.worker.training.data.dataset import find_world
from dreamfleet.worker.training.dream_facts import NO_DRIVES, describe_world
from dreamfleet.worker.worldmodel.mdnrnn_config import PAPER as PAPER_RNN
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import PAPER as PAPER_VAE
from dreamfleet.worker.worldmodel.vae_config import VAEConfig

WME = "hardmaru/WorldModelsExperiments"


def import_json_model(folder: Path, out: Path) -> Bundle:
    """Write the bundle of a folder with `vae.json` and `rnn.json`, beside `initial_z.json` if it is there.

    Without that, dreams begin at a latent of zeros with deviation 1. `DatasetError` names what is missing or does not
    fit, or a file that cannot be written.
    """
    missing = [name for name in ("vae.json", "rnn.json") if find_json(folder, name) is None]
    if missing:
        raise DatasetError(f"{folder} lacks {' and '.join(missing)} (also looked for in vae/ and rnn/)")
    paths = {name: found for name in PLACES if (found := find_json(folder, name)) is not None}
    vae, rnn = read_vae(paths["vae.json"]), read_mdnrnn(paths["rnn.json"])
    first = paths.get("initial_z.json")
    initial = np.zeros((1, 2, PAPER_VAE.latent), np.float32) if first is None else read_initial_latents(first)
    return _write(out, WME, (vae, PAPER_VAE), (rnn, PAPER_RNN), initial)


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
    initial: NDArray[np.float32], pictures: Preprocessing | None = None,
) -> Bundle:  # fmt: skip
    provenance = {"imported": source, "versions": {"dreamfleet": package_version("dreamfleet")}}
    facts = describe_world(OF_FIRST_WORLD, NO_DRIVES, rnn[1])
    manifest = make_manifest(out.stem, provenance, facts, vae[1], rnn[1], preprocessing=pictures)
    with explain_write_errors(out):
        return write_bundle(out, manifest, export_graphs(vae[0], rnn[0], initial, vae[1], rnn[1]))
