"""Measure an MDN-RNN's predictions: one step ahead, and after steps of dreaming under recorded actions."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dreamfleet.worker.training.data.rollout_batches import (
    Rollouts,
    done_labels,
    load_rollouts,
    model_inputs,
    teacher_force,
    with_reward_label,
)
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN, Prediction, reward_labels
from dreamfleet.worker.worldmodel.mdnrnn_config import calibrate_end

DREAM_STEPS = (1, 10, 50)  # lengths of dreams
START_EVERY = 25  # recorded steps between the beginnings of dreams
MAX_ROLLOUTS = 40  # held-out ones to measure on

Floats = NDArray[np.float32]


def foresight(model: MDNRNN, held_out: Sequence[Path]) -> dict[str, float]:
    """Measure each head on recorded steps, and as `..._after_N` on states after N dreamt steps.

    Binary heads are scored by the area under the ROC curve, values by their root mean square error (RMSE), latents by
    their RMSE in units of their standard deviation. Figures that are undefined, because rollouts are too short or all
    labels are equal, are left out.
    """
    device = next(model.parameters()).device
    rollouts = load_rollouts(held_out[:MAX_ROLLOUTS]).to(device)
    model.eval()
    with torch.no_grad():
        hidden, states = teacher_force(model, rollouts)
        prediction = model.predict(hidden)
        labels = _labels(model, rollouts)
        mask = rollouts.mask > 0
        figures = {
            name: _score_head(model, name, getattr(prediction, name)[mask], label[mask])
            for name, label in labels.items()
        }
        for ahead, (seen, predicted, latents) in _dream(model, rollouts, states).items():
            rows, steps = seen
            for name in labels:
                scores = getattr(predicted, name)
                figures[f"{name}_after_{ahead}"] = _score_head(model, name, scores, labels[name][rows, steps])
            error = (latents - rollouts.mu[rows, steps]).square().mean().sqrt() / rollouts.mu[mask].std()
            figures[f"latent_error_after_{ahead}"] = float(error)
    named = {name if "error" in name else _figure_name(model, name): value for name, value in figures.items()}
    return {name: round(value, 3) for name, value in named.items() if np.isfinite(value)}


def end_quality(model: MDNRNN, held_out: Sequence[Path]) -> dict[str, float]:
    """How good the done head's probabilities are on recorded steps, as `calibrate_end` gives them.

    `done_brier` is their mean squared error, `done_calibration` their mean over the share of ends: below 1, dreams are
    longer than reality. Empty without a done head; without an end there is no `done_calibration`.
    """
    if not model.config.done:
        return {}
    device = next(model.parameters()).device
    predicted, ended = list[Floats](), list[Floats]()
    model.eval()
    with torch.no_grad():
        for start in range(0, len(held_out), MAX_ROLLOUTS):
            for chunk in load_rollouts(held_out[start : start + MAX_ROLLOUTS]).chunks():
                rollouts = chunk.to(device)
                logits = model(model_inputs(model.config, rollouts.mu, rollouts)).done
                for found, part in ((predicted, torch.sigmoid(logits)), (ended, done_labels(model.config, rollouts))):
                    found.append(part[rollouts.mask > 0].cpu().numpy())
    probability = calibrate_end(np.concatenate(predicted).astype(np.float64), model.config.done_weight)
    label = np.concatenate(ended)
    figures = {"done_brier": float(np.square(probability - label).mean())}  # page_builder.py has their units
    if label.any():
        figures["done_calibration"] = float(probability.mean() / label.mean())
    return {name: float(f"{value:.4g}") for name, value in figures.items()}


def area_under_curve(scores: Floats, positive: NDArray[np.bool_]) -> float:
    """Area under the ROC curve: how often a positive scores above a negative; NaN if either kind is missing."""
    ranks = np.empty(len(scores))
    ranks[np.argsort(scores)] = np.arange(1, len(scores) + 1)
    positives = int(positive.sum())
    pairs = positives * (len(scores) - positives)
    return float((ranks[positive].sum() - positives * (positives + 1) / 2) / pairs) if pairs else float("nan")


def _dream(
    model: MDNRNN, rollouts: Rollouts, states: list[Tensor]
) -> dict[int, tuple[tuple[Tensor, Tensor], Prediction, Tensor]]:
    """Dream from recorded states on under the recorded actions, taking the mean of each mixture.

    Returns by number of steps ahead: the recorded steps reached (rows, steps), the predictions there, dreamt latents.
    """
    config, length = model.config, rollouts.mu.shape[1]
    found: dict[int, list[tuple[Tensor, Tensor, Tensor, Tensor]]] = {ahead: [] for ahead in DREAM_STEPS}
    for start in range(START_EVERY, length - 1, START_EVERY):
        latent, state = rollouts.mu[:, start], states[start]
        for ahead in range(1, min(max(DREAM_STEPS), length - 1 - start) + 1):
            hidden, state = model.advance(torch.cat([latent, rollouts.action[:, start + ahead - 1]], dim=1), state)
            predicted = model.predict(hidden)
            weights = predicted.log_weights.exp()
            weights = weights.repeat(1, model.config.latent // model.config.weighted, 1)
            latent = (weights * predicted.means).sum(dim=-1)
            if config.previous_reward:
                state = with_reward_label(
                    model, state, predicted.reward if config.reward == "value" else (predicted.reward > 0).float()
                )
            if ahead in found:
                rows = torch.nonzero(rollouts.mask[:, start + ahead])[:, 0]
                last, _ = model.advance(torch.cat([latent, rollouts.action[:, start + ahead]], dim=1), state)
                found[ahead].append((rows, torch.full_like(rows, start + ahead), last[rows], latent[rows]))
    result = {}
    for ahead, parts in found.items():
        if parts:
            rows, steps, hidden, latents = (torch.cat(each) for each in zip(*parts, strict=True))
            result[ahead] = ((rows, steps), model.predict(hidden), latents)
    return result


def _labels(model: MDNRNN, rollouts: Rollouts) -> dict[str, Tensor]:
    config, labels = model.config, dict[str, Tensor]()
    if config.has_reward_head:
        labels["reward"] = reward_labels(config.reward, rollouts.reward, rollouts.done, config.reward_scale)
    if config.done:
        labels["done"] = done_labels(config, rollouts)
    return labels


def _score_head(model: MDNRNN, name: str, predicted: Tensor, label: Tensor) -> float:
    if name == "reward" and model.config.reward == "value":
        return float((predicted - label).square().mean().sqrt()) * model.config.reward_scale
    return area_under_curve(predicted.cpu().numpy(), label.cpu().numpy() > 0)


def _figure_name(model: MDNRNN, name: str) -> str:
    head, _, ahead = name.partition("_")
    kind = "rmse" if head == "reward" and model.config.reward == "value" else "auc"
    return f"{head}_{kind}" + (f"_{ahead}" if ahead else "")
