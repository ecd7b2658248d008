"""Compute recorded states for a bundle: latents and recurrent states at steps of a folder's drives."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from dreamfleet.worker.training.checkpoint import load_checkpoint, load_config
from dreamfleet.worker.training.data.dataset import episode_paths, find_world, load_steps, world_of_folder
from dreamfleet.worker.training.data.drive_steps import DriveStep, sample_steps
from dreamfleet.worker.training.data.rollout_batches import load_rollouts, teacher_force
from dreamfleet.worker.training.encode import ENCODED
from dreamfleet.worker.training.torch_setup import on_one_thread
from dreamfleet.worker.training.train_mdnrnn import CHECKPOINT
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig

DRIVES = 32  # processed at once: 1000 steps of the default layers' states take 65 MB
SEED = 0


@dataclass(frozen=True)
class RecordedStates:  # docs/explanation/dreams.md
    """States `(N, 2 * latent + state)` in half precision: mu, logvar and the recurrent state before the action.

    `before_losses` of them lie shortly before a loss of the course, or a death.
    """

    states: NDArray[np.float16]
    before_losses: int


def compute_recorded_states(folder: Path, count: int) -> RecordedStates:
    """Compute at most `count` states of a folder's encoded drives by its MDN-RNN; equal folders give equal states."""
    paths, model = episode_paths(folder, ENCODED), MDNRNN(load_config(folder / CHECKPOINT, MDNRNNConfig))
    load_checkpoint(folder / CHECKPOINT, model, None)
    drives, random = [load_steps(path) for path in paths], np.random.default_rng(SEED)
    rewards, deaths = ([drive[name] for drive in drives] for name in ("reward", "terminal"))
    lost_after = find_world(*world_of_folder(folder)).world.lost_after
    drawn = sample_steps(rewards, count, random, lost_after, [bool(each) for each in deaths])
    with on_one_thread(), torch.no_grad():
        rows = [row for part in _batch_by_drive(drawn.all) for row in _states(paths, model, part)]
    width = 2 * model.config.latent + model.config.state
    return RecordedStates(np.array(rows, dtype=np.float16).reshape(-1, width), len(drawn.before_losses))


def _batch_by_drive(moments: Sequence[DriveStep]) -> Iterator[list[DriveStep]]:
    """Yield sorted steps in batches of a few drives."""
    drives = [list(each) for _, each in groupby(moments, key=lambda moment: moment.drive)]
    for start in range(0, len(drives), DRIVES):
        yield [moment for drive in drives[start : start + DRIVES] for moment in drive]


def _states(paths: Sequence[Path], model: MDNRNN, moments: Sequence[DriveStep]) -> Iterator[NDArray[np.float32]]:
    """Yield the state at each of these steps."""
    drives = sorted({moment.drive for moment in moments})
    rollouts = load_rollouts([paths[drive] for drive in drives])
    _, remembered = teacher_force(model, rollouts)
    for drive, step in moments:
        row = drives.index(drive)
        yield torch.cat([rollouts.mu[row, step], rollouts.logvar[row, step], remembered[step][row]]).numpy()
