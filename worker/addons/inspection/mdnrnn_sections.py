"""Sections on the MDN-RNN: a dream beside the drive, predicted rewards, and attention weights."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.worker.addons.inspection.encoded_rollout import EncodedRollout
from dreamfleet.worker.addons.inspection.page import FONT, Section, draw_heatmap, new_figure, picture_grid, render_png
from dreamfleet.worker.addons.inspection.vae_sections import VAEView
from dreamfleet.worker.dream.noise import Draw, EpisodeNoise
from dreamfleet.worker.dream.world import DreamWorld, check_temperature
from dreamfleet.worker.worldmodel.inference import DreamStep, RewardLabel

Floats = NDArray[np.float32]
STEPS = (0, 5, 10, 20, 50, 100, 200, 299)  # of a dream that are drawn
TEMPERATURES = (0.5, 1.0)
LEAST = 1e-4  # of the probabilities that are drawn


def follow_drive(bundle: Bundle, drive: EncodedRollout) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Each step's latent `(1, latent)` and action `(1, actions)`, and the state `(1, state)` that a controller sees."""
    model, label = DreamStep(bundle), RewardLabel(bundle)
    state = model.zero_state(1)
    for latent, action, reward in zip(drive.mu[:, None], drive.action[:, None], drive.reward, strict=True):
        yield latent, action, state
        state = model.advance(latent, action, state)
        label.write(state, np.array([reward]))


def dream_latents(bundle: Bundle, drive: EncodedRollout, temperature: float, seed: int = 0) -> Floats:
    """Dream latents `(T, latent)` from the drive's first one on under its actions."""
    check_temperature(temperature)
    model = DreamStep(bundle)
    noise, latent, state = EpisodeNoise(seed, model.chance), drive.mu[:1], model.zero_state(1)
    latents = []
    for action in drive.action:
        latents.append(latent[0])
        draw = noise.next()
        dream = model.imagine(latent, action[None], state, draw.uniform, draw.normal, temperature, draw.mask)
        latent, state = dream.latent, dream.state
    return np.stack(latents)


def dream_section(bundle: Bundle, drive: EncodedRollout, vae_view: VAEView) -> Section:
    """Draw frames of the drive and of dreams under the same actions."""
    steps = [step for step in STEPS if step < len(drive)]
    rows = [("drive", drive.picture[steps]), ("decoded", vae_view.decode(drive.mu[steps]))]
    for temperature in TEMPERATURES:
        dreamt = dream_latents(bundle, drive, temperature)[steps]
        rows.append((f"dream,\ntemperature\n{temperature}", vae_view.decode(dreamt)))
    opening = f" The first {drive.opening} steps are the world's opening." if drive.opening else ""
    return Section(
        "dream", "A dream beside the drive",
        "The drive's own actions in the model's dream. It begins at the drive's first latent and sees nothing of the "
        f"drive afterwards.{opening}",
        picture_grid(rows, [f"step {step}" for step in steps]),
    )  # fmt: skip


def reward_section(bundle: Bundle, drive: EncodedRollout) -> Section:
    """Draw the predicted and the real reward of each step, and their running sums."""
    world, zeros = DreamWorld(bundle, 1.0), np.zeros((1, bundle.manifest.latent), np.float32)
    awake = [world.imagine(*step, Draw(zeros, zeros)).reward[0] for step in follow_drive(bundle, drive)]
    asleep = _dreamt_rewards(world, drive)
    figure, axes = new_figure(5.2, 2, sharex=True)
    for panel, change, what in ((axes[0, 0], np.asarray, "reward of a step"), (axes[1, 0], np.cumsum, "summed")):
        panel.plot(change(drive.reward), color="0.6", label="real", linewidth=2.2)
        panel.plot(change(awake), color="tab:blue", label="predicted on the drive", linewidth=1.1)
        panel.plot(change(asleep), color="tab:orange", label="in a dream under the same actions", linewidth=1.1)
        panel.set_ylabel(what, fontsize=FONT)
        panel.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=FONT, ncols=3, loc="lower left", bbox_to_anchor=(0, 1))
    axes[1, 0].set_xlabel("step of the drive", fontsize=FONT)
    return Section(
        "rewards", "What it thinks a step is worth",
        "The reward head beside what the world gave: on the drive itself, one step ahead, and in a dream (temperature "
        "1) that only shares its actions.",
        render_png(figure),
    )  # fmt: skip


def _dreamt_rewards(world: DreamWorld, drive: EncodedRollout) -> list[float]:
    noise, rewards = EpisodeNoise(0, world.chance, world.bars), []
    latent, state = drive.mu[:1], world.begin(1)
    for action in drive.action:
        moment = world.imagine(latent, action[None], state, noise.next())
        rewards.append(float(moment.reward[0]))
        latent, state = moment.latent, moment.state
    return rewards


def ends_section(bundle: Bundle, drive: EncodedRollout) -> Section:
    """Draw the predicted probability that each step of the drive is its last, on a logarithmic axis."""
    model, zeros = DreamStep(bundle), np.zeros((1, bundle.manifest.latent), np.float32)
    predicted = [model.imagine(*step, zeros, zeros, 1.0, None).done[0] for step in follow_drive(bundle, drive)]
    figure, axes = new_figure(2.8)
    panel = axes[0, 0]
    panel.plot(np.maximum(predicted, LEAST), color="tab:blue", linewidth=1.2)
    if drive.died:
        panel.axvline(len(drive) - 1, color="tab:red", linewidth=1.5, label="where it ended")
        panel.legend(fontsize=FONT, loc="lower left", bbox_to_anchor=(0, 1))
    panel.set_yscale("log")
    panel.set_ylim(LEAST, 1.2)
    panel.set_xlabel("step of the drive", fontsize=FONT)
    panel.set_ylabel("predicted probability", fontsize=FONT)
    panel.grid(alpha=0.3)
    return Section(
        "ends", "When it expects an end",
        "The probability that the model gives each step of the drive to be the last, one step ahead. `inspect "
        "--survival` measures whether dreams end as early as the world.",
        render_png(figure),
    )  # fmt: skip


def attention_section(bundle: Bundle, drive: EncodedRollout) -> Section | None:
    """Draw the attention weights at each step of the drive; `None` for a model without attention."""
    model = DreamStep(bundle)
    if not model.has_attention:
        return None
    weights = np.concatenate([model.attend(*step) for step in follow_drive(bundle, drive)])
    window = weights.shape[1]
    figure, axes = new_figure(3.4, 1, 2, width_ratios=(4, 1))
    draw_heatmap(axes[0, 0], weights.T, "weight of each input at each step", cmap="magma", vmin=0)
    ages = [f"-{window - 1 - row}" if row < window - 1 else "now" for row in range(window)]
    rows = range(window - 1, -1, -max(1, window // 8))
    axes[0, 0].set_yticks(rows, [ages[row] for row in rows])
    axes[0, 0].set_xlabel("step of the drive", fontsize=FONT)
    axes[0, 0].set_ylabel("input of which step", fontsize=FONT)
    axes[0, 1].barh(range(window), weights.mean(axis=0), color="tab:orange")
    axes[0, 1].axvline(1 / window, color="0.4", linewidth=1)
    axes[0, 1].set_yticks(rows, [ages[row] for row in rows])
    axes[0, 1].invert_yaxis()
    axes[0, 1].set_title("mean; line: even", fontsize=FONT + 1)
    return Section(
        "attention", "Where it looks back",
        f"The weights that attention gives the last {window} inputs; at the drive's beginning some of them are empty.",
        render_png(figure),
    )  # fmt: skip
