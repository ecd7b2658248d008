"""Measuring the dream against its floor and against torch, in one process and alternating blocks."""

from __future__ import annotations

from typing import Any

import numpy as np

from common.bundle import Bundle
from common.messages import TaskSpec
from worker.bench.blocks import Measured, alternate
from worker.bench.policy import MATRIX
from worker.dream.scoring import Dreamer
from worker.tasks.api import Episode

BATCHES = (1, 256, 1024)
CANDIDATES = 64  # of a batch, where it has room for so many
HORIZON = 25  # steps of a measured dream


def bench_dream(bundle: Bundle) -> dict[str, Any]:
    """Dreamed steps a second by batch, whole: noise, controllers, reward and sums included.

    `of_floor`: the rate at 256 over this core's matrix rate by the step's FLOPs; `torch_naive_ratio`: over a step of
    torch modules and distributions at 256.
    """
    dreamer = Dreamer(bundle, TaskSpec("dream", bundle.sha256, HORIZON, 0, temperature=1.25))
    random = np.random.default_rng(0)
    vectors = random.normal(0, 0.1, (CANDIDATES, bundle.controller_shape.size)).astype(np.float32)
    matrix = random.normal(size=(MATRIX, MATRIX)).astype(np.float32)
    product = np.empty_like(matrix)

    def dream(batch: int) -> Measured:
        count = min(batch, CANDIDATES)
        dreams: list[Episode] = [(vector, seed) for vector in vectors[:count] for seed in range(batch // count)]
        return lambda: dreamer.score(dreams)

    cases: dict[str, Measured] = {str(batch): dream(batch) for batch in BATCHES}
    cases["product"] = lambda: np.matmul(matrix, matrix, out=product)
    note = ""
    try:
        from worker.worldmodel.eager import make_torch_dream

        cases["torch"] = make_torch_dream(bundle, 256)
    except ModuleNotFoundError as error:
        note = f"torch_naive_ratio needs {error.name}: pip install 'dreamfleet[train]'"
    seconds = alternate(cases)
    rates = {str(batch): batch * HORIZON / seconds[str(batch)] for batch in BATCHES}
    floor = 2 * MATRIX**3 / seconds["product"] / flops(bundle)
    return {
        "steps_per_second": {batch: round(rate) for batch, rate in rates.items()},
        "of_floor": round(rates["256"] / floor, 3),
        "torch_naive_ratio": round(rates["256"] * seconds["torch"] / 256, 2) if "torch" in seconds else None,
        "floor_steps_per_second": round(floor),
        "flops": flops(bundle),
        **({"note": note} if note else {}),
    }


def flops(bundle: Bundle) -> int:
    """Floating-point operations of one dreamed step, two a multiply-add of its matrix products."""
    manifest = bundle.manifest
    model = manifest.models.get("mdnrnn", {})
    features = manifest.latent + manifest.hidden
    lstm = 4 * manifest.hidden * (features + manifest.actions)
    outputs = 3 * int(model.get("mixtures", 5)) * manifest.latent + 1
    return 2 * (lstm + manifest.hidden * outputs + manifest.actions * features)
