"""The lower bounds of `lab bench policy` and `lab bench dream` ignore slow libraries and inherited settings.
Its peers may do what they like. Tests dispatch.py, measurement.py, simulated_workers.py, sleep_tasks.py and verb.py."""

import hashlib
import os
import time
from contextlib import contextmanager

import numpy as np
import pytest

from dreamfleet.common.host.resource_limits import POOLS
from dreamfleet.common.host.trusted_modules import trust
from dreamfleet.common.protocol.codec import decode, encode
from dreamfleet.common.protocol.messages import MAX_LEASES, TAG_BYTES, Heartbeat, Intervals, Result
from dreamfleet.worker.addons.bench import dispatch
from dreamfleet.worker.addons.bench.matrix_products import LIBRARIES, fastest, product_cases, product_graph
from dreamfleet.worker.addons.bench.simulated_workers import SimulatedWorker
from dreamfleet.worker.addons.bench.sleep_tasks import HALF_SECOND_TASK, NULL_TASK, SLEEP_TASK
from dreamfleet.worker.addons.bench.verb import measure_on_one_thread
from dreamfleet.worker.service.admission import Admission
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worldmodel.inference import open_graph
from tests.support.samples import NONCE, SPEC, UID


def inherited(_bundle):
    """The environment of a measurement's process."""
    return {name: value for name, value in os.environ.items() if "BLAS" in name or name.startswith("ATEN_")}


def test_no_librarys_setting_reaches_a_measurement(monkeypatch):
    settings = {"OPENBLAS_CORETYPE": "Prescott", "OPENBLAS_L2_SIZE": "1", "ATEN_CPU_CAPABILITY": "default"}
    for name, value in {**settings, **dict.fromkeys(POOLS, "2")}.items():
        monkeypatch.setenv(name, value)
    environment = measure_on_one_thread(inherited, "tiny")
    assert not settings.keys() & environment.keys()
    assert environment["OPENBLAS_NUM_THREADS"] == "1"


def test_a_floor_is_each_product_by_the_library_that_is_fastest_at_it():
    seconds = {
        "product 0 by numpy": 2.0, "product 0 by torch": 3.0, "product 0 by onnxruntime": 1.0,
        "product 1 by numpy": 4.0, "product 1 by onnxruntime": 5.0, "step": 0.1,
    }  # fmt: skip
    assert fastest(seconds, 2) == (5.0, ("onnxruntime", "numpy"))


def test_numpy_and_the_runtime_are_always_asked():
    cases = product_cases([((3, 4), (4, 5)), ((2, 3, 4), (2, 4, 1))])
    assert {f"product {index} by {name}" for index in (0, 1) for name in ("numpy", "onnxruntime")} <= cases.keys()
    assert len(cases) <= 2 * len(LIBRARIES)
    for call in cases.values():
        call()


@pytest.mark.parametrize(("left", "right"), [((3, 4), (4, 5)), ((2, 3, 200), (2, 200, 1))])
def test_the_runtimes_product_is_one(left, right):
    random = np.random.default_rng(0)
    first, second = (random.normal(size=shape).astype(np.float32) for shape in (left, right))
    (product,) = open_graph(product_graph(left, second), threads=1).run(["out"], {"left": first})
    assert np.allclose(product, first @ second, atol=1e-5)


@contextmanager
def hanging():
    yield lambda _work, _count: time.sleep(3600)


@contextmanager
def failing():
    raise RuntimeError("not today")
    yield


@contextmanager
def prompt():
    yield lambda work, count: [work(index) for index in range(min(count, 2))]


def test_a_peer_is_measured_in_a_process_of_its_own():
    assert dispatch.run_peer(prompt).keys() == {"efficiency_50ms", "null_jobs_per_second"}


def test_a_peer_that_hangs_or_fails_has_no_figures(monkeypatch):
    assert dispatch.run_peer(failing) is None
    monkeypatch.setattr(dispatch, "PEER_SECONDS", 1.0)
    assert dispatch.run_peer(hanging) is None


@pytest.mark.parametrize("name", [SLEEP_TASK, NULL_TASK, HALF_SECOND_TASK])
def test_a_worker_finds_its_tasks_by_name(name):
    trust([name.partition(":")[0]])
    assert find_task(name).name == name


def test_a_simulated_workers_heartbeat_lists_what_a_real_ones_may():
    admission = Admission("bench", UID, 3, NONCE, SPEC, Intervals(beat=1.0, repeat=1.0))
    worker = SimulatedWorker("crowd-0", admission, slots=64, seconds=0.0)
    digests = [hashlib.sha256(number.to_bytes(4, "big")).digest() for number in range(MAX_LEASES + 76)]
    for digest in digests:
        worker.outbox.add(Result(digest, 0.0, 1, 0.0, None, None))
    heard = decode(Heartbeat, encode(worker.beat()))
    assert heard.unacked == tuple(digest[:TAG_BYTES] for digest in digests[:MAX_LEASES])
