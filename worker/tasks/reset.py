"""Resetting an environment with a seed that may be too long for it."""

from __future__ import annotations

from typing import Any

import gymnasium

from dreamfleet.common.runs.seeds import TRAINING_LAST, fold_seed

REFUSALS = (ValueError, TypeError, OverflowError, AssertionError, gymnasium.error.Error)  # of a seed that is too long
KNOWN = "_dreamfleet_refuses_long_seeds"  # an environment's attribute, once it has shown that


def reset_folded(environment: gymnasium.Env[Any, Any], seed: int) -> Any:
    """Reset the environment and return its first observation.

    Training seeds have up to 53 bits. An environment that takes at most 31 bits gets `fold_seed` of the others. It is
    one if it refuses the longest seed twice and takes that seed folded; any other error of a reset is raised.
    """
    if vars(environment).get(KNOWN) and seed != fold_seed(seed):
        return environment.reset(seed=fold_seed(seed))[0]
    try:
        return environment.reset(seed=seed)[0]
    except REFUSALS as error:
        if seed == fold_seed(seed) or not _refuses_long_seeds(environment, type(error)):
            raise
    vars(environment)[KNOWN] = True
    return environment.reset(seed=fold_seed(seed))[0]


def _refuses_long_seeds(environment: gymnasium.Env[Any, Any], error: type[Exception]) -> bool:
    """Whether the longest seed raises this error, and not by chance."""
    for _ in range(2):
        try:
            environment.reset(seed=TRAINING_LAST)
        except error:
            continue
        return False
    try:
        environment.reset(seed=fold_seed(TRAINING_LAST))
    except Exception:  # environments may raise anything; the first error tells more
        return False
    return True
