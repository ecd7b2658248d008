"""Benchmark a policy step against its arithmetic alone and against torch, in one process and alternating blocks."""

from __future__ import annotations

import numpy as np

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.worker.addons.bench.matrix_products import fastest, product_cases
from dreamfleet.worker.addons.bench.measurement import TimedCall, time_alternately
from dreamfleet.worker.worldmodel.inference import PolicyStep

MATRIX = 768  # large enough to be all arithmetic, small enough for many blocks


def bench_policy(bundle: Bundle) -> dict[str, float | str | None]:
    """Measure a policy step at batch 1.

    `over_floor`: its time divided by the time of its FLOPs (`flops`) at this core's matrix rate. That rate is of a
    product of two 768 x 768 matrices in the library that is fastest at it. The bound ignores that a step at batch 1
    must also fetch each weight. `torch_ratio`: torch's time divided by ours.
    """
    policy, random = PolicyStep(bundle), np.random.default_rng(0)
    picture = random.integers(0, 256, (1, *bundle.manifest.picture), dtype=np.uint8)
    parameters = random.normal(0, 0.1, (1, policy.shape.size)).astype(np.float32)
    state = policy.zero_state(1)
    cases: dict[str, TimedCall] = {"step": lambda: policy.step(picture, parameters, state)}
    cases |= product_cases([((MATRIX, MATRIX), (MATRIX, MATRIX))])
    note = ""
    try:
        from dreamfleet.worker.addons.bench.torch_steps import make_torch_step

        cases["torch"] = make_torch_step(bundle, picture, parameters)
    except ModuleNotFoundError as error:
        note = f"torch_ratio needs {error.name}: pip install 'dreamfleet[train]'"
    seconds = time_alternately(cases)
    least, (library,) = fastest(seconds, 1)
    rate = 2 * MATRIX**3 / least
    return {
        "over_floor": round(seconds["step"] * rate / flops(bundle), 3),
        "torch_ratio": round(seconds["torch"] / seconds["step"], 2) if "torch" in seconds else None,
        "microseconds": round(seconds["step"] * 1e6, 1),
        "torch_microseconds": round(seconds["torch"] * 1e6, 1) if "torch" in seconds else None,
        "flops": flops(bundle),
        "gflops_of_core": round(rate / 1e9, 1),
        "floor_by": library,
        **({"note": note} if note else {}),
    }


def flops(bundle: Bundle) -> int:
    """Floating-point operations of one policy step's matrix products, two per multiply-add."""
    manifest = bundle.manifest
    vae = manifest.models.get("vae", {"padding": "valid", "channels": (32, 64, 128, 256)})
    side, before, total = manifest.picture[0], manifest.picture[2], 0
    for channels in vae["channels"]:
        side = side // 2 if vae["padding"] == "same" else side // 2 - 1
        total += side**2 * 16 * before * channels
        before = channels
    features = manifest.latent + manifest.hidden
    lstm = 4 * manifest.hidden * (features + manifest.actions)
    return 2 * (total + side**2 * before * manifest.latent + lstm + manifest.actions * features)
