"""A run of submitted batches, without a transport."""

from dataclasses import replace

import numpy as np

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.protocol.batches import BatchReply, pack_batch
from dreamfleet.common.protocol.codec import encode_json
from dreamfleet.common.protocol.messages import MAX_MESSAGE, MAX_PART
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.coordinator.run.batches import Batches
from tests.support.dispatched import result
from tests.support.run_bench import Bench
from tests.support.samples import SPEC

SHAPE = ControllerShape(1, 3)

SIZE = SHAPE.size

SETTINGS = RunSettings(
    SPEC, SHAPE, 2, 2, 0.1, "diagonal", 1, evaluate_every=0, evaluation_episodes=1, optimiser="external",
    on_failure="worst",
)  # fmt: skip


class Door(Bench):
    """A run in a folder and the queries to it; the test itself is the worker."""

    workers = ()

    def __init__(self, path):
        self.scored = []
        super().__init__(path, None, SETTINGS, generations=0)

    def begin(self):
        super().begin()
        self.batches = Batches(self.run, "search")

    def go_on(self):
        self.run.advance(self.now)
        assert self.run.commit()

    def query(self, verb, payload=b"", **parameters) -> BatchReply:
        texts = {name: str(value) for name, value in parameters.items()}
        reply = self.batches.answer(verb, texts.get, payload, self.now)
        assert len(encode_json(reply)) <= MAX_MESSAGE
        return reply

    def submit(self, batch_id, count=2, seeds=(1, 2), first=0.0, **changes):
        header, body = pack_batch(batch_id, vectors(count, first), seeds or None, changes.pop("episodes", 0))
        return self.send(replace(header, **changes), body)

    def send(self, header, body, order=None):
        offsets = range(0, len(body), MAX_PART)
        for place in order or range(len(offsets)):
            part = body[offsets[place] : offsets[place] + MAX_PART]
            reply = self.query("submit", part, **vars(header), offset=offsets[place])
        return reply

    def work(self, most=10**9):
        """Score wanted jobs of the open generation: the sum of the vector plus the seed."""
        self.score(most)
        self.go_on()

    def score(self, most=10**9):
        """As `work`, without a commit."""
        for work in self.run.generation.missing[:most]:
            fitness = float(np.frombuffer(work.vector, "<f4").sum()) + work.job.seeds[0]
            self.scored.append(work.job.digest)
            self.run.fleet.leases.withdraw([work.job.digest])
            self.run.record_result(work, result(work.digest, fitness, steps=7), "a/1", "f", "c")


def vectors(count, first=0.0):
    return first + np.arange(count * SIZE, dtype=np.float32).reshape(count, SIZE)
