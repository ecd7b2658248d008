"""Resetting an environment with a seed that may be too long for it."""

from __future__ import annotations

from typing import Any

import gymnasium

from dreamfleet.common.runs.seeds import fold_seed


def reset_folded(environment: gymnasium.Env[Any, Any], seed: int) -> Any:
    """Reset the environment and return its first observation.

    Training seeds have up to 53 bits. If an environment raises on one of over 31 bits, it gets `fold_seed` of it.
    """
    try:
        observation, _ = environment.reset(seed=seed)
    except Exception:  # environments may raise anything
        if seed == fold_seed(seed):
            raise
        observation, _ = environment.reset(seed=fold_seed(seed))
    return observation
