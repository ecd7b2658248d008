"""A run whose messages and clock a test moves, without a transport."""

import hashlib
from dataclasses import replace

from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.protocol.host_classes import class_from_fingerprint
from dreamfleet.common.protocol.messages import (
    MAX_PART,
    TAG_BYTES,
    Heartbeat,
    HelloRequest,
    Intervals,
    Result,
    ResultBatch,
    UploadPart,
)
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.run.worker_protocol import WorkerProtocol
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.storage.journal import Journal
from tests.support.dispatched import result
from tests.support.samples import SPEC

A, B = "a/00000001", "b/00000002"

DRIVES = 2

SETTINGS = RunSettings(
    SPEC, ControllerShape(1, 3), 2, 1, 0.1, "diagonal", 1, evaluate_every=0, evaluation_episodes=1, collect_every=1,
    collect_episodes=DRIVES,
)  # fmt: skip


class Bench:
    """A run in a folder; a test delivers its messages and moves its clock."""

    strict = False
    is_secured = False
    failure_limit = 0.5
    host_class = class_from_fingerprint("f")  # of both workers
    workers = (A, B)

    def __init__(self, path, bundle, settings=SETTINGS, generations=1):
        self.path, self.now = path, 0.0
        self.settings, self.limits = settings, LimitsConfig(generations=generations)
        path.mkdir(parents=True)
        self.journal = Journal.create(path, settings, bundle)
        self.begin()

    def begin(self):
        self.given = []  # jobs that were fetched and not finished
        network = NetworkConfig(beat=1.0, strict=self.strict, failure_limit=self.failure_limit)
        self.run = Run(self.journal, self.settings, self.limits, network, self.now, is_secured=self.is_secured)
        self.worker_protocol = WorkerProtocol(self.run, "night", "n", Intervals(1.0, 1.0))
        self.run.advance(self.now)
        self.run.commit()
        for name in self.workers:
            self.admit(name)
            self.handle_heartbeat(name)

    def fingerprint_of(self, name):
        return "f"

    def class_of(self, name):
        """As far as the worker knows its class."""
        return self.host_class

    def request(self, name):
        known = {"host_class": self.class_of(name)}
        return HelloRequest(2, 2, "0", name, (SPEC.task,), self.fingerprint_of(name), 1, **known)

    def admit(self, *names):
        for name in names:
            self.run.admission.admit(self.request(name), self.now)

    def restart(self):
        """Kill the coordinator, which loses everything that is not committed, and begin the next incarnation."""
        self.journal.close()
        self.journal = Journal(self.path / "journal.sqlite")
        self.begin()

    def wait(self, seconds=1.0):
        self.now += seconds
        self.run.tick(self.now)

    def handle_heartbeat(self, name, unacked=()):
        if (member := self.run.fleet.members.get(name)) is None:
            return
        head = {"run_uid": self.run.uid, "incarnation": self.run.incarnation, "nonce": "n", "drawn_by": "-",
                "numbering": member.numbering}  # fmt: skip
        tags = tuple(digest[:TAG_BYTES] for digest in unacked)
        self.worker_protocol.handle_heartbeat(
            name,
            Heartbeat(**head, seen=member.number, capacity=4, slots=4, queued=(), running=(), unacked=tags, load=0.0,
                 steps_per_second=0.0, host_class=self.class_of(name)),
            self.now,
        )  # fmt: skip

    def send(self, name, *results):
        """A worker's results arrive, and the run has not gone on yet."""
        known = {"fingerprint": self.fingerprint_of(name), "host_class": self.class_of(name)}
        batch = ResultBatch(run_uid=self.run.uid, incarnation=1, results=results, **known)
        self.worker_protocol.handle_results(name, batch, self.now)

    def deliver(self, name, result):
        self.send(name, result)
        self.run.advance(self.now)
        self.run.commit()

    def answer(self, result):
        """Deliver a result from a worker that holds the job."""
        wanted = self.run.fleet.jobs.get(result.digest)
        self.deliver(min(wanted.holders, default=A) if wanted else A, result)

    def upload(self, name, part):
        self.worker_protocol.handle_upload(name, part, self.now)

    def parts(self, job):
        data = drive_of(job)
        return [
            UploadPart(
                run_uid=self.run.uid, incarnation=1, digest=job.digest, sha256=hashlib.sha256(data).digest(),
                offset=offset, total=len(data), data=data[offset : offset + MAX_PART],
            )
            for offset in range(0, len(data), MAX_PART)
        ]  # fmt: skip

    def verdicts(self):
        sends = self.run.fleet.dispatch(self.now)
        return [(send.identity, each.digest, each.verdict) for send in sends for each in send.verdicts]

    def fetch(self):
        """What is given now: each job with its worker."""
        fetched = [(send.identity, work.job) for send in self.run.fleet.dispatch(self.now) for work in send.work]
        self.given += [job for _, job in fetched]
        return fetched

    def fitness_of(self, job):
        """What `finish` says of a job."""
        return 1.0

    def finish(self, index=0):
        job = self.given.pop(index)
        self.answer(result(job.digest, self.fitness_of(job)))

    def close(self, generations):
        """Answer jobs until so many generations are closed and no background job is in progress."""
        while len(self.run.history) < generations or self.run.background_jobs.in_progress:
            self.step()

    def saved(self):
        """The reported controller, if there is one."""
        path = self.path / CONTROLLER
        return Controller.load(path) if path.exists() else None

    def step(self):
        """Answer the first job that was given."""
        self.fetch()
        self.finish()

    def end(self):
        while self.run.state.ended is None:
            self.step()

    def score(self, fitness=lambda job: 1.0):
        """Score what is given now."""
        for name, job in self.fetch():
            self.deliver(name, result(job.digest, fitness(job)))

    def reach_collection(self):
        """Score the only generation; the collection jobs, each with its holder."""
        while not self.run.fleet.drain_background:
            self.score()
        return self.collecting()

    def collecting(self):
        given = {job.episode: (name, job) for name, job in self.fetch()}
        return [given[episode] for episode in sorted(given)]

    def kept(self):
        with RunFolder(self.path) as folder:
            return [path.read_bytes() for path in folder.rollouts()]


EVALUATED = replace(SETTINGS, collect_every=0, evaluate_every=2, evaluation_episodes=2, population=4)
SCORES = {1: 10.0, 3: 5.0}  # of the mean after a generation


class Reporting(Bench):
    def fitness_of(self, job):
        return SCORES[job.generation] if job.kind == "evaluate" else float(job.digest[0])


def drive_of(job):
    """A rollout of a little more than two parts, a pure function of the job."""
    return hashlib.sha256(job.digest).digest() * (2 * MAX_PART // 32) + job.digest


def result_of(job):
    return Result(job.digest, 5.0, 10, 0.1, None, hashlib.sha256(drive_of(job)).digest())
