"""An attacker of a run named `test`, whose attacks repeat for as long as the run lasts.

It knows all names, lives, nonces, batches and fingerprints, which an open port shows to everybody. At a secured port it
gets them from a session with the right to hear everything, so that no attack fails for lack of knowledge.
"""

import json
import threading
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import msgspec

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
from tests.support import same_bits, tasks
from tests.support.failures import failure
from tests.support.hand import direct
from tests.support.samples import JSON, MSGPACK

RUN, GENERATIONS, POPULATION = "test", 4, 4
FORGED = ("f", "a guess")  # fingerprints
SETTINGS = ("--task", tasks.SLOW_TOY, "--population", POPULATION, "--episodes", 1, "--evaluate-every", 0,
            "--generations", GENERATIONS, "--seed", 5)  # fmt: skip
CLAIMED = (keys.live_coordinator(RUN, "f" * 16), keys.live_worker(RUN, "own.1/0badc0de"))  # liveliness tokens of nobody
ASKED = 5  # seconds that a query stays open; nothing waits for it


class Intruder:
    """A worker that the attacker lets join; with a `capacity` it gets jobs, which it never runs."""

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
    """Sends valid messages through a raw `session`, and overhears everything through the session `ears`.

    `seat` is the seat of its join file; the names of its intruders end in it.
    """

    def __init__(self, session, ears, seat=None):
        self.session, self.seat = session, seat
        self.jobs = {}  # of all workers, by digest
        self.head = None  # the last overheard batch
        self.worker = None  # the recipient of that batch
        self.fingerprint = None
        self.dropped = {}  # from the coordinator's last status
        self.steered = []  # keys of accepted control requests
        self.overheard, self.asked = [], []  # keys of samples and queries that reached its own session
        self.seen = set()  # liveliness tokens
        end = "" if seat is None else f".{seat}"
        self.reporter, self.holder = Intruder(f"reporter{end}/0badc0de", 0), Intruder(f"holder{end}/0badc0de", 1)
        self._held = [
            ears.declare_subscriber(keys.all_workers("job", RUN), direct(self._overhear_batch)),
            ears.declare_subscriber(keys.all_workers("result", RUN), direct(self._overhear_results)),
            ears.declare_subscriber(keys.event_status(RUN), direct(self._overhear_farewell)),
            ears.liveliness().declare_subscriber(
                f"{keys.ROOT}/**", direct(lambda token: self.seen.add(str(token.key_expr)))
            ),
        ]

    def pose(self, session):
        """Pose as a coordinator and subscribe to all messages, in a session that sends none."""
        whole = f"{keys.ROOT}/**"
        answered = (keys.hello(RUN), f"{keys.hello(RUN)}/**", keys.status(RUN), f"{keys.status(RUN)}/**",
                    keys.bundle(RUN, "*"), keys.claim(RUN, "*"), keys.control(RUN, "*"))  # fmt: skip
        record = direct(lambda heard: self.overheard.append(str(heard.key_expr)))
        kinds = ("job", "result", "beat", "upload")
        self._held += [session.declare_subscriber(keys.all_workers(kind, RUN), record) for kind in kinds]
        self._held += [each.declare_subscriber(whole, record) for each in (session, session.liveliness())]
        self._held += [self.session.liveliness().declare_token(key) for key in CLAIMED]
        self._held += [session.declare_queryable(key, direct(self._answer)) for key in answered]

    def _answer(self, query):
        with query:
            self.asked.append(str(query.key_expr))
            query.reply(query.key_expr, b"rubbish")

    def _overhear_batch(self, sample):
        batch, worker = decode(JobBatch, sample.payload.to_bytes()), keys.worker_from_key(str(sample.key_expr))
        for intruder in (self.reporter, self.holder):
            if worker == intruder.identity:
                intruder.take(batch)
        if worker.startswith("own") and batch.nonce != "forged":
            self.head, self.worker = batch, worker
        self.jobs.update({job.digest: job for job in batch.jobs})

    def _overhear_results(self, sample):
        fingerprint = decode(ResultBatch, sample.payload.to_bytes()).fingerprint
        self.fingerprint = self.fingerprint if fingerprint in FORGED else fingerprint

    def _overhear_farewell(self, sample):
        self.dropped = json.loads(sample.payload.to_bytes())["dropped"]

    def hello(self, worker):
        request = replace(JSON["hello-request"], worker=worker, fingerprint=self.fingerprint or FORGED[0], slots=1,
                          tasks=(tasks.SLOW_TOY,), protocol_min=2, protocol_max=2)  # fmt: skip
        where = keys.hello(RUN) if self.seat is None else keys.secured_hello(RUN, worker)
        self.session.get(where, lambda _: None, payload=encode_json(request), timeout=ASKED)

    def steer(self, where):
        """Send a control request; remember it if it is accepted."""

        def answered(reply):
            if reply.ok is not None and b'"accepted"' in (said := reply.ok.payload.to_bytes()):
                self.steered += [where] * decode_json(ControlReply, said).accepted

        self.session.get(where, answered, timeout=ASKED)

    def join(self, intruder, steps):
        """Let an intruder join; its beat claims to run all jobs that it got, at so many steps."""
        if self.fingerprint is None or self.head is None:
            return
        self.hello(intruder.identity)
        running = tuple(RunningJob(digest[:TAG_BYTES], steps) for digest in list(intruder.held)[-64:])
        beat = msgspec.structs.replace(
            MSGPACK["beat"], run_uid=self.head.run_uid, incarnation=self.head.incarnation, nonce=self.head.nonce,
            numbering=intruder.numbering, seen=intruder.seen, capacity=intruder.capacity, slots=intruder.capacity,
            queued=(), unacked=(), running=running,
        )  # fmt: skip
        self.session.put(keys.heartbeat(RUN, intruder.identity), encode(beat))

    def report(self, worker, *results, fingerprint=None):
        if self.head is not None:
            batch = ResultBatch(run_uid=self.head.run_uid, incarnation=self.head.incarnation, results=results,
                                fingerprint=fingerprint or self.fingerprint or FORGED[0])  # fmt: skip
            self.session.put(keys.result(RUN, worker), encode(batch))

    def forge(self, **changes):
        """Send a forged batch to the overheard worker."""
        if self.head is not None:
            own = {"vectors": (), "jobs": (), "cancels": (), "verdicts": (), **changes}
            batch = msgspec.structs.replace(self.head, **own)
            self.session.put(keys.job(RUN, self.worker), encode(batch))


def lie(digest):
    return Result(digest, 1e9, 10, 0.1, None, None)


def fail(digest):
    return Result(digest, None, 0, 0.1, failure("forged"), None)


def reports_all_jobs(evil, _round):
    for worker in ("stranger/00000001", "another/00000002"):
        evil.report(worker, *map(lie, list(evil.jobs)[-32:]))
        evil.report(worker, *map(fail, list(evil.jobs)[-32:]))


def reports_a_foreign_fingerprint_as_a_worker(evil, _round):
    if evil.worker is not None:
        evil.report(evil.worker, *map(lie, list(evil.jobs)[-32:]), fingerprint=FORGED[1])


def joins_and_reports_others_jobs(evil, _round):
    evil.join(evil.reporter, 0)
    others = list(evil.jobs)[-16:]
    evil.report(evil.reporter.identity, *map(lie, others), *map(fail, others))


def joins_and_holds_its_jobs_by_growing_steps(evil, number):
    evil.join(evil.holder, 10**12 + number)


def greets_as_the_working_worker(evil, _round):
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
        if number < 2:  # uses up numbers; once in each numbering, since more would keep a worker idle
            evil.forge(number=evil.head.number + 1)


def fills_a_workers_memory(evil, number):
    if evil.head is not None and number < 20:
        for each in range(20):
            rubbish = VectorPart(id=bytes([number, each]) * 16, dtype="<f4", shape=(2**40,), offset=0,
                                 data=bytes(MAX_PART))  # fmt: skip
            evil.forge(number=2**41 + 100 * number + each, vectors=(rubbish,))


# Attacks that only certificates prevent.


def reports_as_the_working_worker(evil, _round):
    if evil.worker is not None:
        others = list(evil.jobs)[-16:]
        evil.report(evil.worker, *map(lie, others), *map(fail, others))


def beats_as_the_working_worker(evil, _round):
    if evil.worker is not None:
        intruder = Intruder(evil.worker, 1)
        evil.join(intruder, 10**12)


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
    reports_all_jobs, reports_a_foreign_fingerprint_as_a_worker, joins_and_reports_others_jobs,
    joins_and_holds_its_jobs_by_growing_steps, greets_as_the_working_worker, steers_by_wildcards,
    sends_a_worker_batches_that_nobody_counted, fills_a_workers_memory,
]  # fmt: skip
SECURED = [*OPEN, reports_as_the_working_worker, beats_as_the_working_worker, sends_a_worker_home,
           says_that_the_run_is_over]  # fmt: skip


def outcome(processes):
    """What the run computed, and the names of scoring workers."""
    with open_run(processes.runs, RUN) as run:
        results = [each for g in range(GENERATIONS) for i in range(POPULATION) for each in run.results(g, i)]
        return same_bits.outcome(processes, RUN), {each.worker.partition("/")[0].partition(".")[0] for each in results}


@contextmanager
def attacking(network, *actions, ears=None):
    """Repeat these attacks within the context, for as long as the run lasts.

    With `ears`, a network that may subscribe to everything, the attacker has a join file and also poses.
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
