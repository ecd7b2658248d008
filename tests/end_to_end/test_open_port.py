"""Who does what at an open port, without certificates: it is refused or bounded, and the run ends with the same bits.

The attacker has a session of Zenoh and nothing else: it overhears names, lives, nonces, batches and fingerprints. What
rules cannot hold off is not here: docs/threats.md names it.
"""

import json
import socket
import threading
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import zenoh

from dreamfleet.common import keys
from dreamfleet.common.codec import decode, decode_json, encode, encode_json
from dreamfleet.common.messages import (
    MAX_PART,
    TAG_BYTES,
    ControlReply,
    JobBatch,
    Result,
    ResultBatch,
    Running,
    VectorPart,
)
from dreamfleet.common.runs import open_run
from dreamfleet.common.session import Network, open_session
from tests.support import tasks
from tests.support.samples import JSON, MSGPACK

pytestmark = pytest.mark.timeout(180)
RUN, GENERATIONS, POPULATION = "test", 3, 4
FORGED = ("f", "a guess")  # fingerprints
SETTINGS = ("--task", tasks.SLOW_TOY, "--population", POPULATION, "--evaluate-every", 0, "--generations", GENERATIONS,
            "--seed", 5)  # fmt: skip


class Guest:
    """A worker that the attacker has the run welcome; with a `capacity` it is given jobs, which it never does."""

    def __init__(self, identity, capacity):
        self.identity, self.capacity = identity, capacity
        self.numbering = self.seen = 0
        self.held = {}

    def take(self, batch):
        if batch.numbering > self.numbering:
            self.numbering, self.seen = batch.numbering, 0
        self.seen = max(self.seen, batch.number)
        self.held.update({job.digest: job for job in batch.jobs})


class Attacker:
    """A raw session that hears everything; what it tells is of the schema, as whoever reads the sources can have it."""

    def __init__(self, session):
        self.session = session
        self.jobs = {}  # that were given to anybody, by digest
        self.head = None  # of the last batch that it overheard
        self.worker = None  # whom that was for
        self.fingerprint = None
        self.dropped = {}  # as the coordinator told it when it left
        self.teller, self.holder = Guest("teller/0badc0de", 0), Guest("holder/0badc0de", 1)
        self._heard = [
            session.declare_subscriber(keys.any_worker("job", RUN), direct(self._overhear_batch)),
            session.declare_subscriber(keys.any_worker("result", RUN), direct(self._overhear_results)),
            session.declare_subscriber(keys.event_status(RUN), direct(self._overhear_farewell)),
        ]

    def _overhear_batch(self, sample):
        batch, worker = decode(JobBatch, sample.payload.to_bytes()), keys.worker_of(str(sample.key_expr))
        for guest in (self.teller, self.holder):
            if worker == guest.identity:
                guest.take(batch)
        if worker.startswith("own/") and batch.nonce != "forged":
            self.head, self.worker = batch, worker
        self.jobs.update({job.digest: job for job in batch.jobs})

    def _overhear_results(self, sample):
        fingerprint = decode(ResultBatch, sample.payload.to_bytes()).fingerprint
        self.fingerprint = self.fingerprint if fingerprint in FORGED else fingerprint

    def _overhear_farewell(self, sample):
        self.dropped = json.loads(sample.payload.to_bytes())["dropped"]

    def hello(self, worker):
        """Greet as this worker."""
        request = replace(JSON["hello-request"], worker=worker, fingerprint=self.fingerprint or FORGED[0], slots=1,
                          tasks=(tasks.SLOW_TOY,), protocol_min=2, protocol_max=2)  # fmt: skip
        list(self.session.get(keys.hello(RUN), payload=encode_json(request), timeout=5))

    def join(self, guest, steps):
        """Have a guest welcomed; it tells that it runs all that it was given, and has made so many steps."""
        if self.fingerprint is None or self.head is None:
            return
        self.hello(guest.identity)
        running = tuple(Running(digest[:TAG_BYTES], steps) for digest in list(guest.held)[-64:])
        beat = replace(
            MSGPACK["beat"], run_uid=self.head.run_uid, incarnation=self.head.incarnation, nonce=self.head.nonce,
            numbering=guest.numbering, seen=guest.seen, capacity=guest.capacity, slots=guest.capacity, queued=(),
            unacked=(), running=running,
        )  # fmt: skip
        self.session.put(keys.beat(RUN, guest.identity), encode(beat))

    def tell(self, worker, *results, fingerprint=None):
        if self.head is not None:
            batch = ResultBatch(run_uid=self.head.run_uid, incarnation=self.head.incarnation, results=results,
                                fingerprint=fingerprint or self.fingerprint or FORGED[0])  # fmt: skip
            self.session.put(keys.result(RUN, worker), encode(batch))

    def forge(self, **changes):
        """A batch to the worker that it overheard."""
        if self.head is not None:
            batch = replace(self.head, **{"vectors": (), "jobs": (), "cancels": (), "verdicts": (), **changes})
            self.session.put(keys.job(RUN, self.worker), encode(batch))


def direct(callback):
    return zenoh.handlers.Callback(callback, indirect=False)


def lie(digest):
    return Result(digest, 1e9, 10, 0.1, None, None)


def fail(digest):
    return Result(digest, None, 0, 0.1, "forged", None)


def tells_results_of_everybodys_jobs(evil, _round):
    for worker in ("stranger/00000001", "another/00000002"):
        evil.tell(worker, *map(lie, list(evil.jobs)[-32:]))


def tells_failures_of_everybodys_jobs(evil, _round):
    for worker in ("stranger/00000001", "another/00000002"):
        evil.tell(worker, *map(fail, list(evil.jobs)[-32:]))


def tells_in_a_workers_name_what_is_not_of_its_host(evil, _round):
    if evil.worker is not None:
        evil.tell(evil.worker, *map(lie, list(evil.jobs)[-32:]), fingerprint=FORGED[1])


def joins_and_tells_what_others_were_given(evil, _round):
    evil.join(evil.teller, 0)
    others = list(evil.jobs)[-16:]
    evil.tell(evil.teller.identity, *map(lie, others), *map(fail, others))


def joins_and_holds_its_jobs_by_growing_steps(evil, number):
    evil.join(evil.holder, 10**12 + number)


def greets_as_the_worker_that_works(evil, _round):
    if evil.worker is not None:
        evil.hello(evil.worker)


def steers_by_wildcards(evil, _round):
    for where in ("dreamfleet/v2/*/control/stop", "dreamfleet/v2/**/pause", "dreamfleet/*/test/control/drain",
                  "dreamfleet/v2/test/control/*"):  # fmt: skip
        for reply in evil.session.get(where, timeout=5):
            if reply.ok is not None and b'"accepted"' in (said := reply.ok.payload.to_bytes()):
                assert not decode_json(ControlReply, said).accepted


def sends_a_worker_batches_that_nobody_counted(evil, number):
    if evil.head is not None:
        evil.forge(numbering=evil.head.numbering + 1000 + number)
        evil.forge(number=2**40 + number)
        evil.forge(nonce="forged", number=number + 1)
        evil.forge(incarnation=99)
        if number < 2:  # numbers used up: of each numbering once, for who does nothing else keeps a worker idle
            evil.forge(number=evil.head.number + 1)


def fills_a_workers_memory(evil, number):
    if evil.head is not None and number < 20:
        for each in range(20):
            rubbish = VectorPart(id=bytes([number, each]) * 16, dtype="<f4", shape=(2**40,), offset=0,
                                 data=bytes(MAX_PART))  # fmt: skip
            evil.forge(number=2**41 + 100 * number + each, vectors=(rubbish,))


def connects_without_end(evil, number):
    if number < 5:
        for _ in range(200):
            socket.create_connection(evil.address).close()


ACTIONS = [
    tells_results_of_everybodys_jobs, tells_failures_of_everybodys_jobs,
    tells_in_a_workers_name_what_is_not_of_its_host, joins_and_tells_what_others_were_given,
    joins_and_holds_its_jobs_by_growing_steps, greets_as_the_worker_that_works, steers_by_wildcards,
    sends_a_worker_batches_that_nobody_counted, fills_a_workers_memory, connects_without_end,
]  # fmt: skip


def outcome(processes):
    """Every fitness of every candidate, and the reported controller."""
    with open_run(processes.runs, RUN) as run:
        fitness = [[run.fitness(g, i) for i in range(POPULATION)] for g in range(GENERATIONS)]
        told = {each.worker.partition("/")[0] for g in range(GENERATIONS) for i in range(POPULATION)
                for each in run.results(g, i)}  # fmt: skip
        return fitness, np.load(run.controller_path)["parameters"].tobytes(), told


@contextmanager
def attacking(processes, *actions):
    """While this is on, each of these is done again and again, for as long as the run is there."""
    over, failed = threading.Event(), []
    with open_session(Network(connect=(processes.endpoint,))) as session:
        evil = Attacker(session)
        evil.address = ("127.0.0.1", processes.port)

        def go_on():
            number = 0
            while not over.is_set():
                try:
                    for action in actions:
                        action(evil, number)
                except OSError:  # the run is over, and its port closed
                    over.wait(0.1)
                except Exception as error:
                    failed.append(error)
                    return
                number += 1
                over.wait(0.05)

        thread = threading.Thread(target=go_on)
        thread.start()
        try:
            yield evil
        finally:
            over.set()
            thread.join()
        assert not failed, failed


@pytest.fixture(scope="module")
def unharmed(tmp_path_factory, random_bundle):
    from tests.support.processes import processes_in

    with processes_in(tmp_path_factory.mktemp("unharmed")) as processes:
        coordinator = processes.coordinator("--bundle", random_bundle.path, *SETTINGS)
        processes.worker("--task", tasks.SLOW_TOY, "--name", "own")
        assert coordinator.finish()[0] == 0
        return outcome(processes)


def harmed(processes, random_bundle, *actions):
    coordinator = processes.coordinator("--bundle", random_bundle.path, *SETTINGS)
    with attacking(processes, *actions) as evil:
        processes.worker("--task", tasks.SLOW_TOY, "--name", "own")
        assert coordinator.finish(120)[0] == 0
    return evil, coordinator


def test_all_at_once_change_no_bit(processes, random_bundle, unharmed):
    evil, coordinator = harmed(processes, random_bundle, *ACTIONS)
    assert outcome(processes) == unharmed, "\n".join(coordinator.lines)
    assert evil.dropped.keys() >= {
        "result of a stranger", "result of a job that was not given", "result of another fingerprint than its worker's",
        "lease with more steps than a job has",
    }  # fmt: skip
    assert not any("paused" in line for line in coordinator.lines)


@pytest.mark.long
@pytest.mark.parametrize("action", ACTIONS, ids=lambda action: action.__name__)
def test_each_alone_changes_no_bit(processes, random_bundle, unharmed, action):
    harmed(processes, random_bundle, action)
    assert outcome(processes) == unharmed
