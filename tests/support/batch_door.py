"""A run of submitted batches, without a transport."""

from dataclasses import replace

import numpy as np

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.protocol.batches import BatchReply, pack_batch
from dreamfleet.common.protocol.codec import encode_json
from dreamfleet.common.protocol.messages import MAX_MESSAGE, MAX_PART, Result
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.coordinator.run.batches import Batches
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.storage.journal import Journal
from tests.support.samples import SPEC

SHAPE = ControllerShape(1, 3)

SIZE = SHAPE.size

SETTINGS = RunSettings(
    SPEC, SHAPE, 2, 2, 0.1, "diagonal", 1, evaluate_every=0, evaluation_episodes=1, optimiser="external",
    on_failure="worst",
)  # fmt: skip


class Door:
    """A run in a folder and the queries to it; the test itself is the worker."""

    def __init__(self, path):
        self.path, self.now, self.scored = path, 0.0, []
        path.mkdir(parents=True)
        self.journal = Journal.create(path, SETTINGS, None)
        self.begin()

    def begin(self):
        self.run = Run(self.journal, SETTINGS, LimitsConfig(), NetworkConfig(), self.now)
        self.batches = Batches(self.run, "search")
        self.step()

    def restart(self):
        """Lose what is not committed."""
        self.journal.close()
        self.journal = Journal(self.path / "journal.sqlite")
        self.begin()

    def step(self):
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
        for work in self.run.generation.missing[:most]:
            fitness = float(np.frombuffer(work.vector, "<f4").sum()) + work.job.seeds[0]
            self.scored.append(work.job.digest)
            self.run.fleet.leases.withdraw([work.job.digest])
            self.run.record_result(work, Result(work.job.digest, fitness, 7, 0.1, None, None), "a/1", "f", "c")
        self.step()


def vectors(count, first=0.0):
    return first + np.arange(count * SIZE, dtype=np.float32).reshape(count, SIZE)
