"""Pictures of one's own, as a VAE sees and decodes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pygame
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.regular_files import open_regular
from dreamfleet.common.printable import truncate
from dreamfleet.worker.inspection.charts import picture_grid
from dreamfleet.worker.inspection.page import Section
from dreamfleet.worker.inspection.vae_view import VAEView
from dreamfleet.worker.training.data.world import find_world

MOST, MOST_BYTES = 8, 50_000_000  # pictures, and of a file
NAME = 16  # characters of a heading
Pictures = NDArray[np.uint8]


def own_pictures(vae_view: VAEView, paths: Sequence[Path]) -> Section:
    """What is seen and decoded of each; `UsageError` for what is no picture."""
    if len(paths) > MOST:
        raise UsageError(f"--picture takes {MOST} files at most, not {len(paths)}")
    seen = np.stack([fit_picture(_read(path), vae_view.side) for path in paths])
    decoded = vae_view.decode(vae_view.encode(seen)[0])
    error = np.square((decoded.astype(np.float64) - seen) / 255).sum(axis=(1, 2, 3))
    told = ", ".join(f"{truncate(path.name, 60)} {each:.1f}" for path, each in zip(paths, error, strict=True))
    rows = [("seen", seen), ("decoded", decoded)]
    return Section(
        "own", "Pictures of your own",
        f"Each as the model sees it, and the decoder's picture of its mean latent. An observation of the world is "
        f"prepared as on a drive, any other picture cut to its middle square and scaled. Summed squared error: {told}.",
        picture_grid(rows, [truncate(path.name, NAME) for path in paths]),
    )  # fmt: skip


def fit_picture(picture: Pictures, side: int) -> Pictures:
    """A picture `(height, width, 3)` as one of `(side, side, 3)` that a VAE sees."""
    if picture.shape[:2] == (side, side):
        return picture
    known = find_world().preprocessings.values()
    observed = max(each.shape for each in known)  # what is not prepared is the whole observation
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
    """Of any kind of surface, without what is see-through."""
    plain = pygame.Surface(surface.get_size(), depth=24)
    plain.blit(surface, (0, 0))
    return np.ascontiguousarray(pygame.surfarray.array3d(plain).swapaxes(0, 1))
