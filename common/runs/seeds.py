"""Who owns which episode seed, so that no controller is judged on a track that it was chosen on.

0-9999 belong to nobody; 10000-19999 test; 20000-999999 validation; training from 2**20 up.
"""

from __future__ import annotations

import hashlib

TEST = range(10_000, 20_000)
VALIDATION = range(20_000, 1_000_000)
CHOOSING_OFFSET, CONFIRMING_OFFSET = (
    10_000,
    20_000,
)  # the first validation tracks of each; an evaluation has those before
TRAINING_FIRST = 2**20
TRAINING_LAST = 2**53 - 1  # a JSON number keeps every one of them


def training_seed(run_seed: int, generation: int, episode: int) -> int:
    """Seed of one training episode: all candidates of a generation share it, no two generations do.

    A hash rather than a sum, so that runs with neighbouring seeds share no track.
    """
    return _derive_seed(f"dreamfleet training {run_seed} {generation} {episode}")


def collection_seed(run_seed: int, generation: int, episode: int) -> int:
    """Seed of one rollout that is kept for training: a training track, and none that a candidate is scored on."""
    return _derive_seed(f"dreamfleet collection {run_seed} {generation} {episode}")


def search_seed(run_seed: int, stage: int) -> int:
    """Seed of the search that a stage, counted from 1, begins anew: no stage draws what an earlier one drew.

    The first one's is the run's own; the others' fit any library's 32 bits.
    """
    return run_seed if stage == 1 else _derive_seed(f"dreamfleet search {run_seed} {stage}") % 2**32


def validation_seeds(episodes: int, first: int = 0) -> tuple[int, ...]:
    """So many validation seeds from the `first` on.

    Every evaluation has those from 0 on, so that its curve is comparable. What chooses between evaluated means uses
    those from `CHOOSING_OFFSET` on. The reported score uses those from `CONFIRMING_OFFSET` on: they chose nothing.
    """
    return tuple(VALIDATION[first : first + episodes])


def _derive_seed(text: str) -> int:
    number = int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")
    return TRAINING_FIRST + number % (TRAINING_LAST - TRAINING_FIRST + 1)
