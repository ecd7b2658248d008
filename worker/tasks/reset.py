"""Resetting an environment with a seed that may be too long for it."""

from typing import Any

import gymnasium

from dreamfleet.common.runs.seeds import FOLDED_END, TRAINING_LAST, fold_seed

REFUSALS = (ValueError, TypeError, OverflowError, AssertionError, gymnasium.error.Error)  # of a seed that is too long
LONG_SEEDS = (*(2**bits + FOLDED_END // 3 for bits in (33, 36, 40, 44, 48, 52)), TRAINING_LAST)


def reset_folded(environment: gymnasium.Env[Any, Any], seed: int) -> Any:
    """Reset the environment and return its first observation.

    Training seeds have up to 53 bits. If an environment refuses this one and also every other that is longer than 32
    bits, it gets `fold_seed` of it. Any other error of a reset is raised. So which episode a seed means follows from
    the environment and the seed, whatever was scored before.
    """
    try:
        return environment.reset(seed=seed)[0]
    except REFUSALS as error:
        if seed == fold_seed(seed) or not all(_refuses(environment, each, type(error)) for each in LONG_SEEDS):
            raise
    return environment.reset(seed=fold_seed(seed))[0]


def _refuses(environment: gymnasium.Env[Any, Any], seed: int, error: type[Exception]) -> bool:
    try:
        environment.reset(seed=seed)
    except error:
        return True
    except Exception:  # environments may raise anything
        return False
    return False
