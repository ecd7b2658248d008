"""Benchmark a policy step and the dream against their matrix products alone and against torch, in turns."""

from typing import Any

import numpy as np

from dreamfleet.common.artifacts.bundle import EIGHT_BITS, Bundle
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.addons.bench.matrix_products import Size, fastest, product_cases
from dreamfleet.worker.addons.bench.measurement import TimedCall, time_alternately
from dreamfleet.worker.dream.batch import TORCH_ROWS, DreamBatch
from dreamfleet.worker.tasks.batches import Episode
from dreamfleet.worker.worldmodel.inference import PolicyStep

MATRIX = 768  # large enough to be all arithmetic, small enough for many blocks
BATCHES = (1, 256, 1024)  # of dreams
CANDIDATES = 64  # of a batch; fewer in smaller batches
TILE = 256  # rows of the matrix products and of torch's step
HORIZON = 64  # steps of a measured dream


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


def bench_dream(bundle: Bundle) -> dict[str, Any]:
    """Measure dreamed steps per second by batch size, with noise, controllers, reward and sums.

    `of_floor`: at batch 256, the time of the step's matrix products alone divided by the time of the whole step. Each
    product runs at its own size in the library that is fastest at it on this core.
    `cuda_steps_per_second`: the same dreams on a graphics processor, as a worker with `torch_device` dreams them; only
    where torch has one.
    `torch_naive_ratio`: the time of a step of torch modules and distributions at batch 256, divided by ours.
    """
    spec = TaskSpec("dream", bundle.sha256, HORIZON, 0, temperature=1.25)
    dreamer = DreamBatch(bundle, spec)
    random = np.random.default_rng(0)
    vectors = random.normal(0, 0.1, (CANDIDATES, bundle.controller_shape.size)).astype(np.float32)

    def dream(batch: int, dreamer: DreamBatch = dreamer) -> TimedCall:
        count = min(batch, CANDIDATES)
        dreams: list[Episode] = [(vector, seed) for vector in vectors[:count] for seed in range(batch // count)]
        return lambda: dreamer.score(dreams)

    cases: dict[str, TimedCall] = {str(batch): dream(batch) for batch in BATCHES}
    sizes = product_sizes(bundle)
    cases |= product_cases(sizes)
    note = ""
    try:
        from dreamfleet.worker.addons.bench.torch_steps import has_cuda, make_torch_dream
        from dreamfleet.worker.addons.torch_dreams.torch_batch import TorchDreamBatch

        cases["torch"] = make_torch_dream(bundle, TILE)
        if has_cuda() and EIGHT_BITS not in bundle.manifest.models:
            cases["cuda"] = dream(TORCH_ROWS, TorchDreamBatch(bundle, spec, "cuda"))
    except ModuleNotFoundError as error:
        note = f"torch_naive_ratio needs {error.name}: pip install 'dreamfleet[train]'"
    seconds = time_alternately(cases)
    rates = {str(batch): batch * HORIZON / seconds[str(batch)] for batch in BATCHES}
    least, libraries = fastest(seconds, len(sizes))
    floor = TILE / least
    return {
        "steps_per_second": {batch: round(rate) for batch, rate in rates.items()},
        "of_floor": round(rates[str(TILE)] / floor, 3),
        "torch_naive_ratio": round(rates[str(TILE)] * seconds["torch"] / TILE, 2) if "torch" in seconds else None,
        "floor_steps_per_second": round(floor),
        "floor_by": ", ".join(libraries),
        **({"cuda_steps_per_second": round(TORCH_ROWS * HORIZON / seconds["cuda"])} if "cuda" in cases else {}),
        **({"note": note} if note else {}),
    }


def product_sizes(bundle: Bundle) -> tuple[Size, ...]:
    """The sizes of one step's matrix products at `TILE` rows: the LSTM's four gates, the heads, the controllers."""
    manifest = bundle.manifest
    features = manifest.latent + manifest.hidden
    outputs = 3 * int(manifest.models["mdnrnn"]["mixtures"]) * manifest.latent + 1
    return (
        ((TILE, features + manifest.actions), (features + manifest.actions, 4 * manifest.hidden)),
        ((TILE, manifest.hidden), (manifest.hidden, outputs)),
        ((TILE, manifest.actions, features), (TILE, features, 1)),
    )
