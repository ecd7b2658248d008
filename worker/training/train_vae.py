"""Train the VAE on recorded pictures."""

import base64
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.stop_signals import Stop, never_stop
from dreamfleet.worker.training.data import dataset
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.training.spots import find_spots, kept_shares, measure_mean
from dreamfleet.worker.training.training_state import AddPoint, TrainingState, open_loss_curve
from dreamfleet.worker.worldmodel.vae import VAE, PixelWeights
from dreamfleet.worker.worldmodel.vae_config import PAPER, VAEConfig

log = logging.getLogger(__name__)

CHECKPOINT, CURVE = "vae.safetensors", "vae.jsonl"  # also in addons/inspection: vae_sections.py, training_curves.py
VALIDATION_PICTURES = 2000
CURVE_PICTURES = 500  # of them, for the curve during training
MEAN_EPISODES = 48  # first ones to train on, of which the mean picture is
LEAST_DEVIATION = 1e-4  # of pictures that are all equal
ACTIVE_NATS = 0.1  # mean KL divergence per held-out picture above which a latent counts as active

ReportProgress = Callable[[int, str], None]


class VAELossValues(NamedTuple):
    """The values of `VAELoss` as floats."""

    weighted: float
    plain: float
    error: float
    divergence: float


def train_vae(
    folder: Path, config: TrainConfig, report: ReportProgress, layers: VAEConfig = PAPER,
    device: torch.device | None = None, continue_from: Path | None = None, decoder_only: bool = False,
    stop: Stop = never_stop, new: bool = False, events: Path | None = None,
) -> dict[str, float]:  # fmt: skip
    """Train, or resume, up to `config.updates`; return the quality on held-out episodes.

    With `decoder_only` the encoder is frozen, so that latents, MDN-RNNs and controllers stay valid. An interruption
    changes no bit: batches and noise depend on the seed and the update alone. `StoppedError` if `stop` asks for a stop.
    `events` is a folder for TensorBoard events.
    """
    train, held_out = dataset.split_held_out(dataset.episode_paths(folder))
    dataset.check_whole([*train, *held_out], "picture", "preprocessing", "world")
    dataset.check_pictures([*train, *held_out], layers.picture)
    torch.manual_seed(config.seed)
    model = VAE(layers).to(device)
    if decoder_only and continue_from is None and (new or not (folder / CHECKPOINT).exists()):
        raise UsageError("--decoder-only needs an encoder that was trained: give --continue-from")
    schedule = TrainingState(folder / CHECKPOINT, model, config, len(train), continue_from, new)
    progress = schedule.progress
    pixels = _pixel_weights(layers, progress, train, device)
    report(schedule.update, "")
    validation = held_out_pictures(held_out, CURVE_PICTURES)
    batches = dataset.picture_batches(
        train, config.batch, config.seed, progress.get("pool", 0), progress.get("taken", 0)
    )
    epoch_pools = max(1, len(train) // dataset.POOL_EPISODES)
    with open_loss_curve(folder / CURVE, events, schedule.update) as point:
        while schedule.should_continue(stop):
            pool, taken, batch = next(batches)
            schedule.set_rate(pool // epoch_pools)
            torch.manual_seed(config.seed * 1_000_003 + schedule.update)
            loss = backward(model, batch, decoder_only, device, pixels)
            schedule.step(loss.weighted)
            schedule.progress |= {"pool": pool, "taken": taken}
            report(schedule.update, f"error {loss.error:.1f}  KL {loss.divergence:.1f}")
            if schedule.update % 20 == 0:
                point(update=schedule.update, error=loss.error, kl=loss.divergence)
            schedule.finish_update(
                lambda: _record_validation(model, validation, point, schedule.update, device, pixels)
            )
    figures = measure_quality(model, held_out, device)
    if figures["reconstruction_error"] >= figures["mean_picture_error"]:
        log.warning(
            "held-out pictures are nearer to their mean (squared error %.4g) than to this VAE's reconstructions "
            "(%.4g): it is not good enough to evolve on; give it more --updates",
            figures["mean_picture_error"],
            figures["reconstruction_error"],
        )
    return figures


def measure_pixels(paths: Sequence[Path]) -> dict[str, Any]:
    """The mean picture of episodes, rounded to bytes, in base64, and pictures' mean deviation from it, of 1.

    Both follow from integers alone, so that they are the same on every host.
    """
    parts = [(len(pictures), pictures.sum(axis=0, dtype=np.int64)) for pictures in map(dataset.load_pictures, paths)]
    count, total = sum(length for length, _ in parts), np.sum([each for _, each in parts], axis=0)
    mean = (2 * total + count) // (2 * count)
    away = sum(int(np.abs(dataset.load_pictures(path) - mean).sum()) for path in paths)
    deviation = away / (255 * count * mean.size)
    return {"mean": base64.b64encode(mean.astype(np.uint8).tobytes()).decode(), "deviation": deviation}


def _pixel_weights(
    layers: VAEConfig, progress: dict[str, Any], train: Sequence[Path], device: torch.device | None
) -> PixelWeights | None:
    """The configured weights; `progress` keeps what they were measured as, as drives may be added before a resume."""
    if not layers.pixel_weight:
        return None
    if "pixels" not in progress:
        progress["pixels"] = measure_pixels(train[:MEAN_EPISODES])
    mean = np.frombuffer(base64.b64decode(progress["pixels"]["mean"]), np.uint8)
    shape = (1, layers.picture, layers.picture, 3)
    deviation = max(progress["pixels"]["deviation"], LEAST_DEVIATION)
    return PixelWeights(as_tensor(mean.reshape(shape).copy(), device)[0], deviation, layers.pixel_weight)


def _record_validation(
    model: VAE, pictures: NDArray[np.uint8], point: AddPoint, update: int, device: torch.device | None,
    pixels: PixelWeights | None,
) -> float:  # fmt: skip
    """Validate, add a point to the curve, and return the weighted held-out loss."""
    loss = validate(model, pictures, device, pixels)
    parts = {"held_out": loss.plain, "held_out_error": loss.error, "held_out_kl": loss.divergence}
    point(update=update, **parts)
    return loss.weighted


def backward(
    model: VAE, pictures: NDArray[np.uint8], decoder_only: bool, device: torch.device | None,
    pixels: PixelWeights | None = None,
) -> VAELossValues:  # fmt: skip
    """Compute a batch's gradients; return its losses."""
    model.train()
    if decoder_only:
        model.freeze_encoder()
    noise = torch.randn(len(pictures), model.config.latent).to(device)
    loss = model.loss(as_tensor(pictures, device), noise, pixels)
    loss.weighted.backward()  # type: ignore[no-untyped-call]
    return VAELossValues(*(part.item() for part in loss))


def validate(
    model: VAE, pictures: NDArray[np.uint8], device: torch.device | None, pixels: PixelWeights | None = None
) -> VAELossValues:
    """Losses on held-out pictures, decoded from the latents' means."""
    model.eval()
    latent = model.config.latent
    with torch.no_grad():
        parts = [
            torch.stack(model.loss(batch, torch.zeros(len(batch), latent, device=device), pixels)) * len(batch)
            for batch in (as_tensor(pictures[start : start + 100], device) for start in range(0, len(pictures), 100))
        ]
    return VAELossValues(*(torch.stack(parts).sum(dim=0) / len(pictures)).tolist())


def held_out_pictures(held_out: Sequence[Path], most: int) -> NDArray[np.uint8]:
    """Every fifth picture of held-out episodes, `most` at most: `(N, side, side, 3)`."""
    found: list[NDArray[np.uint8]] = []
    for path in held_out:
        found.append(dataset.load_pictures(path)[::5])
        if sum(len(each) for each in found) >= most:
            break
    return np.concatenate(found)[:most]


def measure_quality(model: VAE, held_out: Sequence[Path], device: torch.device | None = None) -> dict[str, float]:
    """Squared error per picture of reconstructions and of the mean picture, active latents, and spots that are kept."""
    pictures = held_out_pictures(held_out, VALIDATION_PICTURES)
    mean, deviation = measure_mean(pictures)
    errors, baseline, nats, shown = [], [], [], []
    model.eval()
    with torch.no_grad():
        for start in range(0, len(pictures), 100):
            batch = as_tensor(pictures[start : start + 100], device)
            mu, logvar = model.encode(batch)
            decoded = model.decode(mu)
            errors.append((decoded - batch).square().sum(dim=(1, 2, 3)).cpu().numpy())
            shown.append((255 * decoded).permute(0, 2, 3, 1).cpu().numpy())
            baseline.append(((pictures[start : start + 100] / 255.0 - mean / 255) ** 2).sum(axis=(1, 2, 3)))
            nats.append((0.5 * (mu.square() + logvar.exp() - logvar - 1)).cpu().numpy())
    active = (np.concatenate(nats).mean(axis=0) > ACTIVE_NATS).sum()
    spots = find_spots(pictures, np.concatenate(shown), mean, deviation)
    return {
        "reconstruction_error": round(float(np.concatenate(errors).mean()), 2),
        "mean_picture_error": round(float(np.concatenate(baseline).mean()), 2),
        "active_latents": int(active),
        **kept_shares(spots),
    }


def as_tensor(pictures: NDArray[np.uint8], device: torch.device | None = None) -> torch.Tensor:
    """Convert pictures `(N, side, side, 3)` uint8 to a tensor `(N, 3, side, side)` in [0, 1]."""
    return torch.from_numpy(pictures).to(device).permute(0, 3, 1, 2).float() / 255
