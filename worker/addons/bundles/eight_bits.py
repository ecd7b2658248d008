"""Turn a bundle into one whose encoder and LSTM multiply eight-bit integers. Pages: mixed-hosts.md, measurements.md."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import (
    DREAM_GRAPH,
    EIGHT_BITS,
    ENCODER,
    INITIAL_LATENTS_PART,
    LINEAR_CONTROLLER,
    POLICY,
    SINGLE_PRECISION,
    Bundle,
    write_bundle,
)
from dreamfleet.common.errors import BundleError
from dreamfleet.common.files.archives import parse_array
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.worker.addons.bundles.unbundle import Models, restore_models
from dreamfleet.worker.tasks.registry import task_of
from dreamfleet.worker.training.data.data_folder import explain_write_errors
from dreamfleet.worker.worldmodel import export
from dreamfleet.worker.worldmodel.eight_bits import Ranges
from dreamfleet.worker.worldmodel.inference import Decoder, DreamStep, open_graph

DREAMS, STEPS, EVERY = 32, 250, 10  # dreams, their steps, and the steps from one picture to the next
SPREAD = 0.3  # standard deviation of the parameters of the random controllers that dream
FARTHEST = 10  # times the largest latent of a picture: a dream that goes farther has lost its world
MARGIN = 1.125  # reality goes beyond dreams: the largest outputs were 14 % higher in drives

Floats = NDArray[np.float32]


def write_eight_bit_bundle(bundle: Bundle, out: Path) -> Bundle:
    """Write the same world model with products of eight-bit integers.

    Its own dreams show how large its numbers become. `BundleError` for a bundle whose weights cannot be restored, that
    has them already, or whose encoder has another activation than `relu`; `DatasetError` if it cannot be written.
    """
    models = restore_models(bundle)
    if models.ranges is not None:
        raise BundleError(f"{bundle.path} has eight-bit products already")
    if models.vae_config.activation != "relu":
        raise BundleError(f"{bundle.path}: eight bits need an encoder with activation relu")
    ranges = measure_ranges(bundle, models)
    vae, rnn, vae_config, rnn_config = models.vae, models.mdnrnn, models.vae_config, models.mdnrnn_config
    parts = {name: bundle.read(name) for name in bundle.manifest.parts}
    parts[ENCODER] = export.export_encoder(vae, vae_config, ranges)
    parts[DREAM_GRAPH] = export.export_dream(rnn, rnn_config, ranges)
    if POLICY in parts:
        actions: Any = task_of(bundle).world.actions
        parts[POLICY] = export.export_policy(vae, rnn, vae_config, rnn_config, actions, ranges)
        parts[LINEAR_CONTROLLER] = export.export_controller(actions, hidden=False, ordered=True)
    manifest = bundle.manifest
    made = replace(
        manifest, name=out.stem, parts={}, provenance=manifest.provenance | {SINGLE_PRECISION: bundle.sha256},
        models=manifest.models | {EIGHT_BITS: to_plain(ranges)},
    )  # fmt: skip
    with explain_write_errors(out):
        return write_bundle(out, made, parts)


def measure_ranges(bundle: Bundle, models: Models) -> Ranges:
    """The largest numbers in a world model's own dreams, under random controllers, and a margin."""
    pictures, inputs = _dream(bundle)
    graph = open_graph(export.export_activations(models.vae, models.vae_config), threads=1)
    real = float(np.abs(parse_array(bundle.read(INITIAL_LATENTS_PART))[:, 0]).max())
    dreamt = float(np.abs(inputs[:, : bundle.manifest.latent]).max())
    if not dreamt <= FARTHEST * max(real, 1.0):  # false for NaN too
        raise BundleError(
            f"{bundle.path}: its dreams reach latents of {dreamt:.3g}, where pictures have {real:.3g} at most, so they "
            "do not say how large its numbers become: train its MDN-RNN longer"
        )
    largest = [float(each.max()) for each in graph.run(None, {"picture": pictures})]
    if not min(largest) > 0:
        raise BundleError(f"{bundle.path}: a layer of its encoder gives nothing but zeros")
    config = models.mdnrnn_config
    plain = not config.window and not config.previous_reward  # other inputs have no known range
    return Ranges(_widen(largest), _widen(np.abs(inputs).max(axis=0).tolist()) if plain else ())


def _dream(bundle: Bundle) -> tuple[NDArray[np.uint8], Floats]:
    """Pictures of dreams (N, side, side, 3), and the LSTM's inputs in them: latents and actions (M, inputs)."""
    random, step, decoder = np.random.default_rng(0), DreamStep(bundle), Decoder(bundle)
    first = parse_array(bundle.read(INITIAL_LATENTS_PART))[:, 0]
    latent = np.resize(first, (DREAMS, step.latent_size)).astype(np.float32)
    state = step.zero_state(DREAMS)
    parameters = random.normal(0, SPREAD, (DREAMS, bundle.controller_shape.size)).astype(np.float32)
    pictures, inputs = [decoder.decode(latent)], []
    for number in range(1, STEPS + 1):
        shape = (DREAMS, step.latent_size)
        uniform, normal = random.random(shape, np.float32), random.standard_normal(shape, np.float32)
        moment = step.step(latent, parameters, state, uniform, normal, 1.0)
        inputs.append(np.concatenate([latent, moment.action], axis=1))
        latent, state = moment.latent, moment.state
        if number % EVERY == 0:
            pictures.append(decoder.decode(latent))
    return np.concatenate(pictures), np.concatenate(inputs)


def _widen(largest: list[float]) -> tuple[float, ...]:
    return tuple(max(each, 1e-3) * MARGIN for each in largest)
