"""Benchmark submitted batches: how many evaluations a second a caller reaches over Zenoh and over HTTP."""

import base64
import http.client
import json
from contextlib import ExitStack, closing
from itertools import count, islice
from typing import Any

import numpy as np

from dreamfleet.common.addons.batches.remote_scorer import RemoteScorer
from dreamfleet.common.host.processes import VerbProcess
from dreamfleet.common.host.reports import ADDRESS
from dreamfleet.worker.addons.bench.dispatch import Figures, start_run
from dreamfleet.worker.addons.bench.measurement import TimedCall, time_alternately
from dreamfleet.worker.addons.bench.sleep_tasks import NULL_TASK

POPULATIONS = (1, 64, 512)  # 1024 are more than a request may hold as text
EPISODES = 1


def bench_batches() -> Figures:
    """Evaluations a second of empty jobs on two simulated workers of 32 slots each, by population: medians.

    An evaluation is one episode of one vector of 867 numbers. The caller waits for each batch before the next.
    """
    with start_run(NULL_TASK, 64, EPISODES, external=True) as run, run.crowd(2, 32):
        run.coordinator.wait_for_report(ADDRESS)
        with ExitStack() as stack:
            scorer = stack.enter_context(RemoteScorer(run.endpoint, "bench"))
            bridge = stack.enter_context(VerbProcess("serve", "--connect", run.endpoint, "--port", 0))
            address = bridge.wait_for_report(ADDRESS)
            text, packed = (stack.enter_context(closing(HttpCaller(address, packed=each))) for each in (False, True))
            ways = {
                "zenoh": lambda vectors, seeds: _score(scorer, vectors, seeds),
                "http": text.score,
                "http_base64": packed.score,
            }
            seeds, random = count(), np.random.default_rng(1)

            def batch(way: str, population: int) -> TimedCall:
                vectors = random.normal(size=(population, scorer.size)).astype(np.float32)
                return lambda: ways[way](vectors, list(islice(seeds, EPISODES)))

            cases = {(way, population): batch(way, population) for population in POPULATIONS for way in ways}
            seconds = time_alternately(cases)
            rates: Figures = {f"population_{population}": {} for population in POPULATIONS}
            for (way, population), each in seconds.items():
                rates[f"population_{population}"][way] = round(population * EPISODES / each)
            return {"evaluations_per_second": rates, "numbers_per_vector": scorer.size}


def _score(scorer: RemoteScorer, vectors: np.ndarray[Any, Any], seeds: list[int]) -> None:
    assert np.isfinite(scorer.score(vectors, seeds=seeds)).all()


class HttpCaller:
    """A caller with one connection, as a program in any language would have it."""

    def __init__(self, address: str, *, packed: bool) -> None:
        self._packed = packed  # send the numbers in base64, not as text
        host, _, port = address.removeprefix("http://").rpartition(":")
        self._connection = http.client.HTTPConnection(host, int(port), timeout=60)

    def score(self, vectors: np.ndarray[Any, Any], seeds: list[int]) -> None:
        """Submit a batch, follow its events to the end, and read its scores."""
        base = "/v1/runs/bench/batches"
        if self._packed:
            packed = base64.b64encode(vectors.astype("<f4").tobytes()).decode()
            body = json.dumps({"vectors": {"float32": packed, "size": vectors.shape[1]}, "seeds": seeds})
        else:
            body = json.dumps({"vectors": vectors.tolist(), "seeds": seeds})
        batch = self._ask("POST", base, body)["id"]
        self._connection.request("GET", f"{base}/{batch}/events")
        self._connection.getresponse().read()
        found = self._ask("GET", f"{base}/{batch}")
        assert None not in found["fitness"]

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _ask(self, method: str, path: str, body: str | None = None) -> dict[str, Any]:
        self._connection.request(method, path, body, {"Content-Type": "application/json"})
        answer: dict[str, Any] = json.loads(self._connection.getresponse().read())
        return answer
