"""The split of episode seeds, so that no controller is evaluated on a track that selected it.

0-9999 unused; 10000-19999 test; 20000-999999 validation; training from 2**20. Pages: ask-tell.md, tasks.md, results.md.
"""

import hashlib
from collections.abc import Sequence

from dreamfleet.common.printable import plural

TEST = range(10_000, 20_000)
VALIDATION = range(20_000, 1_000_000)
# Offsets of the first validation seeds for choosing and for confirming the report; evaluations use those before.
CHOOSING_OFFSET, CONFIRMING_OFFSET = 10_000, 20_000
TRAINING_FIRST = 2**20
FOLDED_END = 2**31  # seeds below it fit into a signed number of 32 bits
TRAINING_LAST = 2**53 - 1  # the largest integer that JSON represents exactly
MAX_RESEEDS = 3  # times that a generation gets other seeds: docs/how-to/unattended.md, docs/how-to/troubleshooting.md


def training_seed(run_seed: int, generation: int, episode: int) -> int:
    """The seed of one training episode, the same for all candidates of a generation.

    A hash and not a sum, so that runs with neighbouring seeds share no track.
    """
    return _derive_seed(f"dreamfleet training {run_seed} {generation} {episode}")


def training_seeds(run_seed: int, generation: int, episodes: int, reseeds: int = 0) -> list[int]:
    """The seeds of a generation that got other ones so many times: those that follow."""
    first = reseeds * episodes
    return [training_seed(run_seed, generation, each) for each in range(first, first + episodes)]


def count_reseeds(run_seed: int, generation: int, seeds: Sequence[int]) -> int:
    """How many times a generation with these seeds got other ones, because all its candidates failed."""
    tries = range(1, MAX_RESEEDS + 1) if seeds else ()
    return next((each for each in tries if list(seeds) == training_seeds(run_seed, generation, len(seeds), each)), 0)


def collection_seed(run_seed: int, generation: int, episode: int) -> int:
    """The seed of one collected rollout: a training track on which no candidate is scored."""
    return _derive_seed(f"dreamfleet collection {run_seed} {generation} {episode}")


def search_seed(run_seed: int, stage: int) -> int:
    """The optimiser's seed in a stage (from 1) that starts a new search: each stage has different random numbers.

    In the first stage it is the run's seed; in others it has 32 bits, as some libraries require.
    """
    return run_seed if stage == 1 else _derive_seed(f"dreamfleet search {run_seed} {stage}") % 2**32


def fold_seed(seed: int) -> int:
    """The seed in 31 bits, for environments that take no more: a smaller one is itself, the others become its rest.

    The result is a training seed too: at least `TRAINING_FIRST`.
    """
    return seed if seed < FOLDED_END else TRAINING_FIRST + seed % (FOLDED_END - TRAINING_FIRST)


def validation_seeds(episodes: int, first: int = 0) -> tuple[int, ...]:
    """`episodes` validation seeds from the offset `first` on.

    All evaluations use those from 0 on, so that they are comparable. Choosing between evaluated means uses those from
    `CHOOSING_OFFSET` on, the reported score those from `CONFIRMING_OFFSET` on, which influence no choice.
    """
    return tuple(VALIDATION[first : first + episodes])


def remark_on_seeds(seeds: Sequence[int]) -> str:
    """What to say of `seeds` that a search scores candidates on; empty if none is a test seed."""
    count = sum(each in TEST for each in seeds)
    if not count:
        return ""
    return (
        f"{count:,} of the {plural(len(seeds), 'seed')} {'is a test seed' if count == 1 else 'are test seeds'} "
        f"({TEST[0]} to {TEST[-1]}): a controller that was selected on them cannot be tested on them; search on seeds "
        f"from {TRAINING_FIRST} on"
    )


def _derive_seed(text: str) -> int:
    number = int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")
    return TRAINING_FIRST + number % (TRAINING_LAST - TRAINING_FIRST + 1)
