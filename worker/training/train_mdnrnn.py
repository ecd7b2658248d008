"""Train the MDN-RNN on encoded rollouts. Pages: sources.md."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.host.stop_signals import Stop, never_stop
from dreamfleet.worker.training.checkpoint import load_config
from dreamfleet.worker.training.data.dataset import episode_paths, existing_episodes, load_steps, split_held_out
from dreamfleet.worker.training.data.rollout_batches import Rollouts, done_labels, load_rollouts, model_inputs
from dreamfleet.worker.training.encode import ENCODED, encodes_mirrored, latents_encoder_hash
from dreamfleet.worker.training.prediction_quality import end_quality, foresight
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.training.train_vae import ReportProgress
from dreamfleet.worker.training.training_state import AddPoint, TrainingState, open_loss_curve
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN, binary_loss, latent_loss, reward_labels, reward_loss
from dreamfleet.worker.worldmodel.mdnrnn_config import ADDABLE_HEADS, REWARDED, MDNRNNConfig

N = TypeVar("N", float, Tensor)
CHECKPOINT, CURVE = "mdnrnn.safetensors", "mdnrnn.jsonl"  # also in addons/inspection/training_curves.py
VALIDATION_ROLLOUTS = 20  # for the curve while training


def train_mdnrnn(
    folder: Path, config: TrainConfig, report: ReportProgress, layers: MDNRNNConfig = REWARDED,
    device: torch.device | None = None, continue_from: Path | None = None, stop: Stop = never_stop, new: bool = False,
    events: Path | None = None,
) -> dict[str, float]:  # fmt: skip
    """Train, or resume, up to `config.updates`; return the quality on held-out episodes.

    An interruption changes no bit: batches and noise depend on the seed and the update alone. `StoppedError` if `stop`
    asks for a stop. `events` is a folder for TensorBoard events.
    """
    train, held_out = split_held_out(episode_paths(folder, ENCODED))
    vae, mirrors = latents_encoder_hash(folder), encodes_mirrored(folder)
    latents = load_steps(train[0], "mu")["mu"].shape[1]
    if layers.latent != latents:
        raise DatasetError(
            f"the encoded rollouts have {latents} latents, this MDN-RNN {layers.latent}: give --set latent={latents}"
        )
    layers = fit_layers(layers, folder, continue_from, new)
    torch.manual_seed(config.seed)
    model = MDNRNN(layers).to(device)
    schedule = TrainingState(folder / CHECKPOINT, model, config, len(train), continue_from, new, ADDABLE_HEADS)
    if schedule.progress.setdefault("vae", vae) != vae:
        raise DatasetError(f"{folder / CHECKPOINT} was trained on latents of another VAE; --new starts over")
    report(schedule.update, "")
    with open_loss_curve(folder / CURVE, events, schedule.update) as point:
        while schedule.should_continue(stop):
            update = schedule.update + 1
            schedule.set_rate(update * config.batch // len(train) if config.decay < 1 else 0)
            random = np.random.default_rng([config.seed, update])
            noise = torch.Generator().manual_seed(config.seed * 1_000_003 + update)
            torch.manual_seed(config.seed * 1_000_003 + update)  # for the dropout
            chosen = random.choice(len(train), size=min(config.batch, len(train)), replace=False)
            flipped = (random.random(len(chosen)) < 0.5) & mirrors
            rollouts = load_rollouts([train[index] for index in chosen], flipped)
            model.train()
            values = backward(model, rollouts, noise, device)
            schedule.step(sum(values.values()))
            report(update, "  ".join(f"{name} {value:z.3f}" for name, value in values.items()))
            if update % 10 == 0:
                point(update=update, **values)
            schedule.finish_update(
                lambda: _record_validation(model, held_out[:VALIDATION_ROLLOUTS], point, schedule.update, device)
            )
    return measure_quality(model, held_out, device)


def fit_layers(
    layers: MDNRNNConfig, folder: Path, continue_from: Path | None = None, new: bool = False
) -> MDNRNNConfig:
    """Return the configuration with what a data set determines: the size of its actions, and a measured reward scale.

    A training that goes on, or continues from a checkpoint, keeps that one's scale. Without drives nothing is fitted.
    """
    paths = sorted((folder / ENCODED).glob("[0-9]*.npz")) or existing_episodes(folder)
    if not paths:
        return layers
    layers = replace(layers, actions=load_steps(paths[0])["action"].shape[1])
    if layers.reward_scale:
        return layers
    own = folder / CHECKPOINT
    begun = own if own.exists() and not new else continue_from
    scale = load_config(begun, MDNRNNConfig).reward_scale if begun else _measure_reward_scale(layers, paths)
    return replace(layers, reward_scale=scale)


def _measure_reward_scale(layers: MDNRNNConfig, paths: Sequence[Path]) -> float:
    """The standard deviation of the rewards to learn from, in six digits; 1 for equal rewards and for no value head."""
    if layers.reward != "value":
        return 1.0
    rewards = np.concatenate([load_steps(path)["reward"] for path in split_held_out(paths)[0]])
    return float(f"{rewards.std(dtype=np.float64):.6g}") or 1.0


def _record_validation(
    model: MDNRNN, paths: Sequence[Path], point: AddPoint, update: int, device: torch.device | None
) -> float:
    """Validate, add a point to the curve, and return the weighted held-out loss."""
    parts = validate(model, paths, device)
    point(update=update, **{f"held_out_{name}": part for name, part in parts.items()})
    return sum(weight_losses(model.config, parts).values())


def backward(
    model: MDNRNN, rollouts: Rollouts, noise: torch.Generator, device: torch.device | None = None
) -> dict[str, float]:
    """Accumulate a batch's gradients, a few rollouts at a time to bound memory; return the unweighted losses."""
    values: dict[str, float] = {}
    for chunk in rollouts.chunks():
        parts = scale_to_batch(losses(model, chunk.to(device), noise), chunk, rollouts)
        torch.stack(list(weight_losses(model.config, parts).values())).sum().backward()  # type: ignore[no-untyped-call]
        values = {name: values.get(name, 0.0) + part.item() for name, part in parts.items()}
    return values


def validate(model: MDNRNN, paths: Sequence[Path], device: torch.device | None = None) -> dict[str, float]:
    """The unweighted losses on held-out rollouts."""
    model.eval()
    noise, values, weight = torch.Generator().manual_seed(0), dict[str, float](), 0.0
    with torch.no_grad():
        for start in range(0, len(paths), VALIDATION_ROLLOUTS):
            rollouts = load_rollouts(paths[start : start + VALIDATION_ROLLOUTS])
            steps = float(rollouts.mask.sum())
            for chunk in rollouts.chunks():
                for name, part in scale_to_batch(losses(model, chunk.to(device), noise), chunk, rollouts).items():
                    values[name] = values.get(name, 0.0) + part.item() * steps
            weight += steps
    return {name: value / weight for name, value in values.items()}


def losses(model: MDNRNN, rollouts: Rollouts, noise: torch.Generator) -> dict[str, Tensor]:
    """The losses of the latents and of each other head, in one pass on latents sampled from mu and logvar."""
    config = model.config
    drawn = torch.randn(rollouts.mu.shape, generator=noise).to(rollouts.mu.device)
    sampled = rollouts.mu + torch.exp(0.5 * rollouts.logvar) * drawn
    prediction = model(model_inputs(config, sampled, rollouts))
    ahead = type(prediction)(*(part[:, :-1] for part in prediction))
    parts = {"latent": latent_loss(ahead, sampled[:, 1:], rollouts.mask[:, 1:])}
    if config.has_reward_head:
        labels = reward_labels(config.reward, rollouts.reward, rollouts.done, config.reward_scale)
        parts["reward"] = reward_loss(config.reward, prediction.reward, labels, rollouts.mask)
    if config.done:
        labels = done_labels(config, rollouts)
        parts["done"] = binary_loss(prediction.done, labels, rollouts.mask, config.done_weight)
    return parts


def weight_losses(config: MDNRNNConfig, parts: Mapping[str, N]) -> dict[str, N]:
    """Multiply each part of the loss by its factor."""
    return {name: config.factors[name] * part for name, part in parts.items()}


def scale_to_batch(parts: dict[str, Tensor], chunk: Rollouts, rollouts: Rollouts) -> dict[str, Tensor]:
    """Scale a chunk's mean losses to their contribution to the mean over all rollouts."""
    ahead = float(chunk.mask[:, 1:].sum() / rollouts.mask[:, 1:].sum())
    every = float(chunk.mask.sum() / rollouts.mask.sum())
    return {name: part * (ahead if name == "latent" else every) for name, part in parts.items()}


def measure_quality(model: MDNRNN, held_out: Sequence[Path], device: torch.device | None = None) -> dict[str, float]:
    """Nats per latent dimension, each head's loss, and the prediction quality on held-out rollouts."""
    parts = validate(model, held_out, device)
    figures = {"nats_per_dimension": round(parts.pop("latent"), 3)}
    figures |= {f"{name}_loss": round(value, 4) for name, value in parts.items()}
    return figures | foresight(model, held_out) | end_quality(model, held_out)
