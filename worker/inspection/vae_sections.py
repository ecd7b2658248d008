"""What the VAE keeps of a picture, and what its latents mean."""

from __future__ import annotations

import numpy as np

from dreamfleet.worker.inspection.charts import FONT, draw_heatmap, new_figure, picture_grid, render_png
from dreamfleet.worker.inspection.encoded_rollout import EncodedRollout
from dreamfleet.worker.inspection.page import Section
from dreamfleet.worker.inspection.vae_view import VAEView

SHOWN = 8  # pictures a row, latents a table
TRAVERSED = np.linspace(-3, 3, 7)
NOISE = (-2, -1, 0, 1, 2)  # means of the latents out of nothing


def reconstructions(drive: EncodedRollout, vae_view: VAEView) -> Section:
    """Pictures of the drive, and what the decoder makes of their means."""
    steps = np.linspace(0, len(drive) - 1, SHOWN).astype(int)
    decoded = vae_view.decode(drive.mu)
    difference = decoded.astype(np.float64) - drive.picture
    error = (np.square(difference / 255)).sum(axis=(1, 2, 3)).mean()
    rows = [("seen", drive.picture[steps]), ("decoded", decoded[steps])]
    return Section(
        "reconstructions", "What it sees, and what it keeps",
        f"Pictures of {drive.description}, and the decoder's picture of each one's mean latent. "
        f"Summed squared error a picture over all {len(drive)} steps: {error:.1f}.",
        picture_grid(rows, [f"step {step}" for step in steps]),
    )  # fmt: skip


def traversals(drive: EncodedRollout, vae_view: VAEView) -> Section:
    """The most active latents, one moved at a time around a picture of the drive."""
    step = drive.most_informative_step
    base = drive.mu[step]
    rows = []
    for latent in drive.most_active[:SHOWN]:
        moved = np.tile(base, (len(TRAVERSED), 1))
        moved[:, latent] = TRAVERSED
        rows.append((f"z{latent}\n{drive.nats[latent]:.1f} nats", vae_view.decode(moved)))
    return Section(
        "traversals", "What a latent means",
        "The latents that carry most on this drive, in nats. In each row one of them is set to -3 to 3, the others "
        f"stay those of step {step}.",
        picture_grid(rows, [f"{value:+.0f}" if value else "0" for value in TRAVERSED]),
    )  # fmt: skip


def latent_moments(drive: EncodedRollout) -> Section:
    """Mean and log variance of every latent over the drive."""
    order, height = drive.most_active, 1.2 + 0.075 * drive.mu.shape[1]
    figure, axes = new_figure(2 * height, 2, sharex=True)
    most = float(np.abs(drive.mu).max())
    draw_heatmap(axes[0, 0], drive.mu[:, order].T, "mean", cmap="RdBu_r", vmin=-most, vmax=most)
    draw_heatmap(axes[1, 0], drive.logvar[:, order].T, "log variance", cmap="viridis")
    for each in axes[:, 0]:
        rows = range(0, len(order), max(1, len(order) // 16))
        each.set_yticks(rows, [f"z{order[row]}" for row in rows], fontsize=FONT - 1)
    axes[1, 0].set_xlabel("step of the drive", fontsize=FONT)
    return Section(
        "latents", "The latents of the drive",
        "Mean and log variance that the encoder gives each latent at each step, the most active latent on top. A log "
        "variance near 0 with a mean near 0 says nothing of the picture.",
        render_png(figure),
    )  # fmt: skip


def samples(vae_view: VAEView) -> Section:
    """Decodings of latents that no picture stands behind."""
    normal = np.random.default_rng(0).standard_normal((SHOWN, vae_view.latent)).astype(np.float32)
    rows = [(f"N({mean}, 1)", vae_view.decode(normal + np.float32(mean))) for mean in NOISE]
    return Section(
        "samples", "Latents out of nothing",
        "The decoder's pictures of random latents: where the latents of real pictures lie, N(0, 1) looks like the "
        "track; far from them it need not.",
        picture_grid(rows, [""] * SHOWN),
    )  # fmt: skip
