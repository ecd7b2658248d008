"""Somebody who wants to harm a run named `test`: what they do, again and again, for as long as it is there.

They know all that can be known: names, lives, nonces, batches and fingerprints, as an open port tells everybody. At a
secured one a session that may hear everything tells it to them, so that nothing is refused for want of knowledge.
"""

import json
import threading
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import numpy as np
import zenoh

from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import decode, decode_json, encode, encode_json
from dreamfleet.common.protocol.messages import (
    MAX_PART,
    TAG_BYTES,
    ControlReply,
    JobBatch,
    Result,
    ResultBatch,
    RunningJob,
    VectorPart,
)
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.transport.session import open_session
from tests.support import tasks
from tests.support.samples import JSON, MSGPACK

RUN, GENERATIONS, POPULATION = "test", 4, 4
FORGED = ("f", "a guess")  # fingerprints
SETTINGS = ("--task", tasks.SLOW_TOY, "--population", POPULATION, "--episodes", 1, "--evaluate-every", 0,
            "--generations", GENERATIONS, "--seed", 5)  # fmt: skip
CLAIMED = (keys.live_coordinator(RUN, "f" * 16), keys.live_worker(RUN, "own.1/0badc0de"))  # tokens of who is not there
ASKED = 5  # seconds that a question stays open: nobody waits for it


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
    """A raw `session`, and `ears`: one that hears everything; what it tells is of the schema, as the sources have it.

    `seat` is that of its join file, in which its guests' names end.
    """

    def __init__(self, session, ears, seat=None):
        self.session, self.seat = session, seat
        self.jobs = {}  # that were given to anybody, by digest
        self.head = None  # of the last batch that it overheard
        self.worker = None  # whom that was for
        self.fingerprint = None
        self.dropped = {}  # as the coordinator told it when it left
        self.steered = []  # by its words
        self.overheard, self.asked = [], []  # keys that its own session heard, or was asked at
        self.seen = set()  # tokens
        end = "" if seat is None else f".{seat}"
        self.teller, self.holder = Guest(f"teller{end}/0badc0de", 0), Guest(f"holder{end}/0badc0de", 1)
        self._held = [
            ears.declare_subscriber(keys.all_workers("job", RUN), direct(self._overhear_batch)),
            ears.declare_subscriber(keys.all_workers("result", RUN), direct(self._overhear_results)),
            ears.declare_subscriber(keys.event_status(RUN), direct(self._overhear_farewell)),
            ears.liveliness().declare_subscriber(
                f"{keys.ROOT}/**", direct(lambda told: self.seen.add(str(told.key_expr)))
            ),
        ]

    def pose(self, session):
        """Stand where a coordinator stands, and listen to what is not for it; in a session that says nothing itself."""
        whole = f"{keys.ROOT}/**"
        answered = (keys.hello(RUN), f"{keys.hello(RUN)}/**", keys.status(RUN), f"{keys.status(RUN)}/**",
                    keys.bundle(RUN, "*"), keys.claim(RUN, "*"), keys.control(RUN, "*"))  # fmt: skip
        told = direct(lambda heard: self.overheard.append(str(heard.key_expr)))
        kinds = ("job", "result", "beat", "upload")
        self._held += [session.declare_subscriber(keys.all_workers(kind, RUN), told) for kind in kinds]
        self._held += [session.declare_subscriber(whole, told), session.liveliness().declare_subscriber(whole, told)]
        self._held += [self.session.liveliness().declare_token(key) for key in CLAIMED]
        self._held += [session.declare_queryable(key, direct(self._answer)) for key in answered]

    def _answer(self, query):
        with query:
            self.asked.append(str(query.key_expr))
            query.reply(query.key_expr, b"rubbish")

    def _overhear_batch(self, sample):
        batch, worker = decode(JobBatch, sample.payload.to_bytes()), keys.worker_from_key(str(sample.key_expr))
        for guest in (self.teller, self.holder):
            if worker == guest.identity:
                guest.take(batch)
        if worker.startswith("own") and batch.nonce != "forged":
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
        where = keys.hello(RUN) if self.seat is None else keys.secured_hello(RUN, worker)
        self.session.get(where, lambda _: None, payload=encode_json(request), timeout=ASKED)

    def steer(self, where):
        """Ask for this; what accepts it is remembered."""

        def answered(reply):
            if reply.ok is not None and b'"accepted"' in (said := reply.ok.payload.to_bytes()):
                self.steered += [where] * decode_json(ControlReply, said).accepted

        self.session.get(where, answered, timeout=ASKED)

    def join(self, guest, steps):
        """Have a guest welcomed; it tells that it runs all that it was given, and has made so many steps."""
        if self.fingerprint is None or self.head is None:
            return
        self.hello(guest.identity)
        running = tuple(RunningJob(digest[:TAG_BYTES], steps) for digest in list(guest.held)[-64:])
        beat = replace(
            MSGPACK["beat"], run_uid=self.head.run_uid, incarnation=self.head.incarnation, nonce=self.head.nonce,
            numbering=guest.numbering, seen=guest.seen, capacity=guest.capacity, slots=guest.capacity, queued=(),
            unacked=(), running=running,
        )  # fmt: skip
        self.session.put(keys.heartbeat(RUN, guest.identity), encode(beat))

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
        evil.steer(where)


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


# What nothing but certificates holds off.


def tells_as_the_worker_that_works(evil, _round):
    if evil.worker is not None:
        others = list(evil.jobs)[-16:]
        evil.tell(evil.worker, *map(lie, others), *map(fail, others))


def beats_as_the_worker_that_works(evil, _round):
    if evil.worker is not None:
        guest = Guest(evil.worker, 1)
        evil.join(guest, 10**12)


def sends_a_worker_home(evil, number):
    if evil.head is not None:
        evil.forge(number=evil.head.number + 1, leave=True)
        evil.forge(number=evil.head.number + 1, cancels=tuple(list(evil.jobs)[-16:]))
        evil.forge(number=evil.head.number + 2 + number)


def says_that_the_run_is_over(evil, _round):
    evil.session.put(keys.event_status(RUN), b'{"run": "test", "state": "ended"}')
    evil.session.put(keys.event_generation(RUN), b"{}")


def steers_by_name(evil, _round):
    for verb in ("pause", "drain", "stop", "disband"):
        evil.steer(keys.control(RUN, verb))


OPEN = [
    tells_results_of_everybodys_jobs, tells_failures_of_everybodys_jobs,
    tells_in_a_workers_name_what_is_not_of_its_host, joins_and_tells_what_others_were_given,
    joins_and_holds_its_jobs_by_growing_steps, greets_as_the_worker_that_works, steers_by_wildcards,
    sends_a_worker_batches_that_nobody_counted, fills_a_workers_memory,
]  # fmt: skip
SECURED = [*OPEN, tells_as_the_worker_that_works, beats_as_the_worker_that_works, sends_a_worker_home,
           says_that_the_run_is_over]  # fmt: skip


def outcome(processes):
    """Every fitness of every candidate, the reported controller, and who scored."""
    with open_run(processes.runs, RUN) as run:
        fitness = [[run.fitness(g, i) for i in range(POPULATION)] for g in range(GENERATIONS)]
        told = {each.worker.partition("/")[0].partition(".")[0] for g in range(GENERATIONS) for i in range(POPULATION)
                for each in run.results(g, i)}  # fmt: skip
        return fitness, np.load(run.controller_path)["parameters"].tobytes(), told


@contextmanager
def attacking(network, *actions, ears=None):
    """While this is on, each of these is done again and again, for as long as the run is there.

    With `ears`, a network whose session may hear everything, the attacker is one with a join file, and poses too.
    """
    over, failed = threading.Event(), []
    with ExitStack() as stack:
        session = stack.enter_context(open_session(network))
        if ears is None:
            evil = Attacker(session, session)
        else:
            evil = Attacker(session, stack.enter_context(open_session(ears)), network.credentials.seat)
            evil.pose(stack.enter_context(open_session(network)))
        evil.endpoint = network.connect[0]

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
