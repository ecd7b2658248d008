"""Drives as other projects write them."""

import numpy as np


def ctallec_drive(folder, number, steps=6, size=64):
    """A drive of ctallec/world-models: each picture is the one after its action, and actions are drawn in advance."""
    random = np.random.default_rng(number)
    folder.mkdir(parents=True, exist_ok=True)
    arrays = {
        "observations": random.integers(0, 256, (steps, size, size, 3), dtype=np.uint8),
        "rewards": random.random(steps),
        "actions": random.random((steps + 4, 3)),
        "terminals": np.arange(steps) == steps - 1,
    }
    np.savez(folder / f"rollout_{number}.npz", **arrays)
    return arrays
