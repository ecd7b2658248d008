"""A VAE of a bundle or a data folder: its reconstructions of a drive and of own pictures, and what its latents mean."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self

import numpy as np
import pygame
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import MissingExtraError, UsageError
from dreamfleet.common.files.regular_files import open_regular
from dreamfleet.common.printable import plural, truncate
from dreamfleet.worker.addons.inspection.encoded_rollout import DriveConfig, EncodedRollout
from dreamfleet.worker.addons.inspection.page import (
    FONT,
    Pictures,
    Section,
    draw_heatmap,
    new_figure,
    picture_grid,
    render_png,
)
from dreamfleet.worker.tasks.recordable import Preprocessing
from dreamfleet.worker.training.spots import SIZES, find_spots, measure_mean
from dreamfleet.worker.worldmodel.inference import Decoder, Encoder, open_graph

SHOWN = 8  # pictures per row, latents per table
TRAVERSED = np.linspace(-3, 3, 7)
BANDS = 4  # of rows, and of columns, in each of which spots are counted
LIGHT = 0.55  # share up to which its colour is light
NOISE = (-2, -1, 0, 1, 2)  # means of the random latents
MOST, MOST_BYTES = 8, 50_000_000  # own pictures, bytes of a file
NAME = 16  # characters of a heading
NEEDED = ("torch", "onnx", "safetensors")  # packages of the extra `train` that reading a checkpoint needs
CHECKPOINT = "vae.safetensors"
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class VAEView:
    """A VAE's functions on pictures `(N, side, side, 3)` and latents `(N, latent)`."""

    side: int
    latent: int
    encode: Callable[[Pictures], tuple[Floats, Floats]]  # to `mu` and `logvar`
    decode: Callable[[Floats], Pictures]

    @classmethod
    def of_bundle(cls, bundle: Bundle) -> Self:
        """The VAE of a world model."""
        manifest = bundle.manifest
        return cls(manifest.picture[0], manifest.latent, Encoder(bundle).encode, Decoder(bundle).decode)

    @classmethod
    def of_folder(cls, folder: Path) -> Self:
        """The last checkpoint in a data folder; `DatasetError` if there is none or it is damaged."""
        if missing := [each for each in NEEDED if find_spec(each) is None]:
            raise MissingExtraError(f"a VAE outside a bundle needs {missing[0]!r}: pip install 'dreamfleet[train]'")
        from dreamfleet.worker.training.checkpoint import load_config, load_weights
        from dreamfleet.worker.worldmodel.export import export_decoder, export_encoder
        from dreamfleet.worker.worldmodel.vae_config import VAEConfig

        config, weights = load_config(folder / CHECKPOINT, VAEConfig), load_weights(folder / CHECKPOINT)
        encoder, decoder = (open_graph(export(weights, config), 1) for export in (export_encoder, export_decoder))

        def encode(picture: Pictures) -> tuple[Floats, Floats]:
            mu, logvar = encoder.run(["mu", "logvar"], {"picture": picture})
            return mu, logvar

        def decode(latent: Floats) -> Pictures:
            (picture,) = decoder.run(["picture"], {"latent": latent})
            return np.asarray(picture, dtype=np.uint8)

        return cls(config.picture, config.latent, encode, decode)


def held_out_drives(folder: Path, vae_view: VAEView, config: DriveConfig) -> Iterator[EncodedRollout]:
    """Load the held-out drives of a data set one by one, `config.steps` steps at most of each."""
    from dreamfleet.worker.training.data import dataset

    _, paths = dataset.split_held_out(dataset.episode_paths(folder))
    world = dataset.find_world(*dataset.world_of_folder(folder)).world
    for path in paths:
        dataset.check_pictures([path], vae_view.side)
        seen, steps = dataset.load_pictures(path)[: config.steps], dataset.load_steps(path)
        mu, logvar = vae_view.encode(seen)
        action, reward = (steps[name][: len(seen)] for name in ("action", "reward"))
        about = f"drive {path.stem}, which is held out"
        yield EncodedRollout(seen, mu, logvar, action, reward.astype(np.float64), about, world.opening)


def reconstructions(drive: EncodedRollout, vae_view: VAEView) -> Section:
    """Draw pictures of the drive above the decoder's pictures of their mean latents."""
    steps = np.linspace(0, len(drive) - 1, SHOWN).astype(int)
    decoded = vae_view.decode(drive.mu)
    difference = decoded.astype(np.float64) - drive.picture
    error = (np.square(difference / 255)).sum(axis=(1, 2, 3)).mean()
    rows = [("seen", drive.picture[steps]), ("decoded", decoded[steps])]
    return Section(
        "reconstructions", "What it sees, and what it keeps",
        f"Pictures of {drive.description}, and the decoder's picture of each one's mean latent. "
        f"Summed squared error a picture over all {plural(len(drive), 'step')}: {error:.1f}.",
        picture_grid(rows, [f"step {step}" for step in steps]),
    )  # fmt: skip


def spots(drive: EncodedRollout, vae_view: VAEView) -> Section:
    """Draw which share of small parts unlike the mean picture is in the decoder's pictures, by size and place."""
    start = drive.first_informative_step
    seen = drive.picture[start:]
    found = find_spots(seen, vae_view.decode(drive.mu[start:]), *measure_mean(seen))
    figure, axes = new_figure(3.9, 1, len(SIZES))
    for each, (least, most) in zip(axes[0], SIZES, strict=True):
        among = found.of_size(least, most)
        count, kept = (
            np.histogram2d(among.row, among.column, BANDS, ((0, 1), (0, 1)), weights=weights)[0]
            for weights in (None, among.kept)
        )
        share = np.divide(kept, count, out=np.full_like(kept, np.nan), where=count > 0)
        mean = f"{kept.sum() / count.sum():.0%} of {plural(int(count.sum()), 'spot')}" if count.any() else "no spots"
        draw_heatmap(each, share, f"{least} to {most} pixels: {mean}", cmap="Blues", vmin=0, vmax=1)
        each.set(xticks=[], yticks=[], facecolor="0.9")
        for row, column in np.argwhere(count):
            text = f"{share[row, column]:.0%}\nof {count[row, column]:.0f}"
            colour = "white" if share[row, column] > LIGHT else "black"
            each.text(column, row, text, ha="center", va="center", fontsize=FONT, color=colour)
    return Section(
        "spots", "The small things that it keeps",
        "Spots are connected pixels far from the drive's mean picture, such as a ball; the decoder has a spot if it "
        f"shows half of its deviation there. The share that it has, by size, and in {BANDS} x {BANDS} fields of the "
        "picture. Grey fields have no spot.",
        render_png(figure),
    )  # fmt: skip


def traversals(drive: EncodedRollout, vae_view: VAEView) -> Section:
    """Draw pictures in which one of the most active latents varies, around a picture of the drive."""
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
    """Draw the mean and the log variance of each latent over the drive."""
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
    """Draw the decoder's pictures of random latents."""
    normal = np.random.default_rng(0).standard_normal((SHOWN, vae_view.latent)).astype(np.float32)
    rows = [(f"N({mean}, 1)", vae_view.decode(normal + np.float32(mean))) for mean in NOISE]
    return Section(
        "samples", "Latents out of nothing",
        "The decoder's pictures of random latents: where the latents of real pictures lie, N(0, 1) looks like the "
        "world; far from them it need not.",
        picture_grid(rows, [""] * SHOWN),
    )  # fmt: skip


def own_pictures(vae_view: VAEView, paths: Sequence[Path], known: Collection[Preprocessing] = ()) -> Section:
    """Draw the user's own pictures as the VAE sees and decodes them; `UsageError` for an unreadable file.

    `known` are the preprocessings of the VAE's world.
    """
    if len(paths) > MOST:
        raise UsageError(f"--picture takes {MOST} files at most, not {len(paths)}")
    seen = np.stack([fit_picture(_read(path), vae_view.side, known) for path in paths])
    decoded = vae_view.decode(vae_view.encode(seen)[0])
    error = np.square((decoded.astype(np.float64) - seen) / 255).sum(axis=(1, 2, 3))
    named = ", ".join(f"{truncate(path.name, 60)} {each:.1f}" for path, each in zip(paths, error, strict=True))
    rows = [("seen", seen), ("decoded", decoded)]
    return Section(
        "own", "Pictures of your own",
        "Each as the model sees it, and the decoder's picture of its mean latent. An observation of the world is "
        "prepared as on a drive, any other picture cut to its middle square and scaled. "
        f"Summed squared error: {named}.",
        picture_grid(rows, [truncate(path.name, NAME) for path in paths]),
    )  # fmt: skip


def fit_picture(picture: Pictures, side: int, known: Collection[Preprocessing] = ()) -> Pictures:
    """Fit a picture `(height, width, 3)` to a VAE's `(side, side, 3)`; `known` as in `own_pictures`."""
    if picture.shape[:2] == (side, side):
        return picture
    observed = max((each.shape for each in known), default=None)  # the largest is the raw observation
    wanted = next((each for each in known if each.size == side), None)
    if picture.shape == observed and wanted is not None:
        return wanted.picture(picture)
    height, width, _ = picture.shape
    edge = min(height, width)
    top, left = (height - edge) // 2, (width - edge) // 2
    surface = pygame.surfarray.make_surface(picture[top : top + edge, left : left + edge].swapaxes(0, 1))
    return _surface_to_array(pygame.transform.smoothscale(surface, (side, side)))


def _read(path: Path) -> Pictures:
    try:
        with open_regular(path, MOST_BYTES) as file:
            return _surface_to_array(pygame.image.load(file, path.name))
    except (OSError, pygame.error) as error:
        raise UsageError(f"--picture {path} cannot be read ({error}): give a PNG or a JPEG") from error


def _surface_to_array(surface: Any) -> Pictures:
    """Convert a surface of any kind to pixels `(height, width, 3)`, on black where it is transparent."""
    plain = pygame.Surface(surface.get_size(), depth=24)
    plain.blit(surface, (0, 0))
    return np.ascontiguousarray(pygame.surfarray.array3d(plain).swapaxes(0, 1))
