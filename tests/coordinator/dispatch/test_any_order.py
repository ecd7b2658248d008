"""Messages get lost, repeated or late, processes restart: each generation still ends with the results of a calm run.

The workers are the real `Backlog` and `Outbox`. A message waits until a rule delivers it, drops it, or delivers it
twice.
"""

from collections import Counter

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from dreamfleet.common.protocol.messages import TAG_BYTES, Heartbeat, JobBatch, Result, RunningJob
from dreamfleet.coordinator.dispatch.fleet import DEPARTURE_GRACE, Fleet
from dreamfleet.coordinator.jobs.generation import Generation
from dreamfleet.coordinator.jobs.work import make_work, vector_bytes
from dreamfleet.worker.service.backlog import Backlog
from dreamfleet.worker.service.outbox import Outbox
from tests.support.failures import failure
from tests.support.samples import HEAD, SPEC

BEAT = 1.0
GENERATIONS, SLOTS = 3, 2
SPECS = (
    SPEC,
    SPEC.with_overrides(horizon=400, patience=0),
    SPEC.with_overrides(horizon=400, patience=0),
)  # of each: a run of two stages
SEEDS = (1000, 1001, 1002)


def population(number):
    return [vector_bytes(np.arange(4.0) + number + candidate / 8) for candidate in range(3)]


def background_work(number):
    """The background jobs beside a generation: an evaluation and a kept rollout."""
    vector = population(number)[0]
    kinds = (("evaluate", (20000, 20001)), ("collect", (5000 + number,)))
    return [work for kind, seeds in kinds for work in make_work(SPEC, kind, number, 0, vector, seeds)]


def fitness_of(digest):
    return int.from_bytes(digest[:4], "little") / 1e6


def lossless(number):
    generation = Generation(number, SPECS[number], population(number), SEEDS, run_spec=SPEC)
    for work in generation.work:
        generation.record(work.job.digest, fitness_of(work.job.digest), 10)
    return generation.fitness().tolist()


class Worker:
    """One life of a worker process, as `dreamfleet.worker.service.run_session` runs it."""

    def __init__(self):
        self.backlog, self.outbox = Backlog(SPEC), Outbox(BEAT)
        self.running = []
        self.joined = None  # the coordinator's life that it joined

    def take(self, send):
        """Take a batch; return whether to say hello, because its numbering is unknown."""
        batch = JobBatch(
            **HEAD, nonce="n", numbering=send.numbering, number=send.number,
            vectors=tuple(send.vectors), cancels=tuple(send.cancels),
            jobs=tuple(work.job for work in send.work), verdicts=tuple(send.verdicts),
        )  # fmt: skip
        if batch.numbering != self.backlog.numbering:
            return batch.numbering > self.backlog.numbering
        assert not self.backlog.add_batch(batch)
        self.outbox.acknowledge(verdict.digest for verdict in batch.verdicts)
        self.running = [digest for digest in self.running if digest not in batch.cancels]
        self.fill()
        return False

    def begin(self, numbering):
        self.backlog.start_numbering(numbering)
        self.backlog.clear()
        self.outbox.resend_all()

    def fill(self):
        while len(self.running) < SLOTS and len(self.outbox) <= 4 * SLOTS and (work := self.backlog.take(1)):
            self.running.append(work[0][0].digest)


class AnyOrder(RuleBasedStateMachine):
    """A run's journal, its coordinator's lives, three hosts, and the wire between them."""

    names = st.sampled_from("abc")

    def __init__(self):
        super().__init__()
        self.now, self.life, self.lives = 0.0, 0, 0
        self.journal = {}  # digest -> fitness, on disk
        self.closed_fitness = []  # the fitness of closed generations
        self.number = 0
        self.workers = {}  # identity -> Worker
        self.hosts = {}  # name -> identity
        self.batches, self.results = [], []  # on the wire
        self.begin()

    def begin(self):
        """Start a coordinator from the journal alone."""
        self.life += 1
        self.fleet = Fleet(BEAT)
        self.fleet.jobs.previous_epoch_until = self.number + 1 if self.life > 1 else -1  # as `Run` sets it
        self.received, self.judged, self.sent = Counter(), Counter(), []
        for number in range(self.number):
            self.fleet.jobs.offer(work for work in background_work(number) if work.job.digest not in self.journal)
        self.open()

    def open(self):
        """Open the next generation, with the results that the journal has."""
        if self.number == GENERATIONS:
            self.fleet.drain_background = True
            return
        self.generation = Generation(self.number, SPECS[self.number], population(self.number), SEEDS, run_spec=SPEC)
        for work in self.generation.missing:
            if work.job.digest in self.journal:
                self.generation.record(work.job.digest, self.journal[work.job.digest], 10)
        self.fleet.jobs.begin_generation(self.number)
        assert all(generation >= self.number - 1 for generation in self.fleet.jobs._accepted.values())
        self.fleet.jobs.offer(self.generation.missing)

    @rule()
    def restart(self):
        self.begin()

    @rule(name=names)
    def start_worker(self, name):
        self.kill_worker(name)
        self.lives += 1
        self.hosts[name] = f"{name}/{self.lives:08x}"
        self.workers[self.hosts[name]] = Worker()
        self.hello(name)

    @rule(name=names)
    def kill_worker(self, name):
        identity = self.hosts.pop(name, None)
        if identity is not None:
            del self.workers[identity]
            self.fleet.handle_departure(identity, self.now)

    @rule(name=names)
    def lose_token(self, name):
        """The connection is cut; both processes live on."""
        if name in self.hosts:
            self.fleet.handle_departure(self.hosts[name], self.now)

    @rule(name=names, heard=st.booleans())
    def hello(self, name, heard=True):
        """The answer may be lost, if it is not the first of this life of the coordinator."""
        identity = self.hosts.get(name)
        if identity is not None:
            worker = self.workers[identity]
            numbering = self.fleet.add_worker(identity, SLOTS, "f", self.now)
            if worker.joined != self.life or (heard and numbering != worker.backlog.numbering):
                worker.joined = self.life
                worker.begin(numbering)

    @rule(name=names, steps=st.integers(0, 2000), rate=st.sampled_from([0.0, 1.0, 1000.0]))
    def handle_heartbeat(self, name, steps=5, rate=100.0):
        identity = self.hosts.get(name)
        if identity is None or self.workers[identity].joined != self.life:
            return  # the service drops heartbeats to another life
        worker = self.workers[identity]
        beat = Heartbeat(
            **HEAD, nonce="n", numbering=worker.backlog.numbering, seen=worker.backlog.seen, capacity=SLOTS,
            slots=SLOTS, load=0.0, drawn_by="-",
            queued=tuple(digest[:TAG_BYTES] for digest in worker.backlog.queued), steps_per_second=rate,
            running=tuple(RunningJob(digest[:TAG_BYTES], steps) for digest in worker.running),
            unacked=tuple(digest[:TAG_BYTES] for digest in worker.outbox.digests),
        )  # fmt: skip
        self.fleet.handle_heartbeat(identity, beat, self.now)

    @rule(durable=st.booleans())
    def dispatch(self, durable=True):
        for send in self.fleet.dispatch(self.now, durable=durable):
            self.batches.append((send.identity, self.life, send))
            if any(send is each for each in self.sent):
                continue  # sent again
            self.sent.append(send)
            assert durable or not send.verdicts, "a verdict before the journal"
            for verdict in send.verdicts:
                self.judged[send.identity, verdict.digest] += 1
            if send.work:
                assert len(self.fleet.members[send.identity].leases) <= 2 * SLOTS, "credit"

    @precondition(lambda self: self.batches)
    @rule(data=st.data(), fate=st.sampled_from(["arrives", "arrives", "twice", "lost"]))
    def deliver_batch(self, data, fate):
        index = data.draw(st.integers(0, len(self.batches) - 1))
        identity, life, send = self.batches[index] if fate == "twice" else self.batches.pop(index)
        if fate != "lost":
            self.hand_over(identity, life, send)

    def hand_over(self, identity, life, send):
        worker = self.workers.get(identity)
        if worker is not None and worker.joined == life and worker.take(send):
            self.hello(identity.partition("/")[0])

    @rule(name=names, fails=st.sampled_from([False] * 9 + [True]))
    def finish(self, name, fails=False):
        worker = self.workers.get(self.hosts.get(name))
        if worker is not None and worker.running:
            digest = worker.running.pop(0)
            outcome = (None, 3, 0.1, failure("boom"), None) if fails else (fitness_of(digest), 10, 0.1, None, None)
            worker.outbox.add(Result(digest, *outcome))
            worker.fill()

    @rule(name=names)
    def send_results(self, name):
        identity = self.hosts.get(name)
        if identity is not None:
            for batch in self.workers[identity].outbox.due(self.now):
                self.results += [(identity, each) for each in batch]

    @precondition(lambda self: self.results)
    @rule(data=st.data(), fate=st.sampled_from(["arrives", "arrives", "twice", "lost", "upload waits"]))
    def deliver_result(self, data, fate):
        index = data.draw(st.integers(0, len(self.results) - 1))
        identity, result = self.results[index] if fate == "twice" else self.results.pop(index)
        if fate == "upload waits":
            self.fleet.defer_verdict(identity, result.digest, self.now)
        elif fate != "lost":
            self.receive(identity, result)

    @rule(name=names, known=st.booleans())
    def a_stranger_sends_a_result(self, name, known):
        """A result of an unknown job, from a known or unknown worker."""
        identity = self.hosts.get(name, "x/0badc0de") if known else "x/0badc0de"
        self.receive(identity, Result(b"never was" + bytes(23), 1e9, 10, 0.1, None, None))

    def receive(self, identity, result):
        self.received[identity, result.digest] += 1
        verdict, work = self.fleet.handle_result(identity, result, self.now)
        assert (work is not None) == (verdict == "accepted")
        if work is not None:
            assert result.digest not in self.journal, "nothing counts twice"
            self.journal[result.digest] = result.fitness
            if work.job.kind == "score":
                self.generation.record(result.digest, result.fitness, result.steps)
        if self.fleet.failure_judge.find_pausing():
            self.fleet.jobs.clear_failures()
        if self.generation.complete and self.number < GENERATIONS:
            self.close()

    def close(self):
        self.closed_fitness.append(self.generation.fitness().tolist())
        self.fleet.jobs.offer(background_work(self.number))
        self.number += 1
        self.open()

    @rule(seconds=st.floats(0.01, 3.0))
    def wait(self, seconds):
        self.now += seconds
        self.fleet.tick(self.now)

    @rule(seconds=st.floats(3.0, 1e5))
    def the_coordinators_host_is_suspended(self, seconds):
        self.fleet.tick(self.now)
        silent = {member.identity for member in self.fleet.members.values() if member.silent}
        self.now += seconds
        self.fleet.tick(self.now)
        assert {member.identity for member in self.fleet.members.values() if member.silent} <= silent

    @rule(name=names, noticed=st.booleans())
    def reconnect(self, name, noticed):
        """A worker is out of sight, shortly or until its jobs are given away, and joins again."""
        if noticed:
            self.lose_token(name)
            self.wait(2 * DEPARTURE_GRACE)
            self.dispatch()
            batches, self.batches = self.batches, []
            for each in batches:
                self.hand_over(*each)
        self.hello(name)
        self.handle_heartbeat(name)

    @rule(finished=st.integers(0, 2))
    def everybody_reconnects_in_turn(self, finished):
        """A fleet of three behind a bad switch."""
        for name in "abc":
            if name not in self.hosts:
                self.start_worker(name)
                self.handle_heartbeat(name)
        for name in "abc":
            self.a_calm_second(finished)
            self.reconnect(name, noticed=True)

    @rule(finished=st.integers(0, 2 * SLOTS))
    def a_calm_second(self, finished):
        """All workers send heartbeats, receive batches and work; their results are not delivered yet."""
        self.wait(BEAT)
        for name in "abc":
            self.handle_heartbeat(name)
        self.dispatch()
        batches, self.batches = self.batches, []
        for each in batches:
            self.hand_over(*each)
        for name in "abc":
            for _ in range(finished):
                self.finish(name)
            self.send_results(name)

    @rule(name=names)
    def a_faithful_worker_ends_it(self, name):
        """From any state, one worker without faults finishes the whole run."""
        self.batches, self.results = [], []
        for other in "abc":
            self.kill_worker(other)
        self.start_worker(name)
        for _ in range(100):
            self.now += BEAT
            self.fleet.tick(self.now)
            self.handle_heartbeat(name)
            self.dispatch()
            batches, self.batches = self.batches, []
            for each in batches:
                self.hand_over(*each)
            while self.workers[self.hosts[name]].running:
                self.finish(name)
            self.send_results(name)
            results, self.results = self.results, []
            for identity, result in results:
                self.receive(identity, result)
            if self.number == GENERATIONS and not self.fleet.jobs:
                break
        assert not self.fleet.jobs
        wanted = [
            work.job.digest
            for number in range(GENERATIONS)
            for work in (*Generation(number, SPECS[number], population(number), SEEDS).work, *background_work(number))
        ]
        assert self.journal == {digest: fitness_of(digest) for digest in wanted}
        assert len(self.closed_fitness) == GENERATIONS

    @invariant()
    def closed_generations_are_those_of_a_fleet_that_loses_nothing(self):
        assert self.closed_fitness == LOSSLESS[: len(self.closed_fitness)]

    @invariant()
    def at_most_two_hold_a_job_and_both_sides_agree(self):
        for digest, wanted in self.fleet.jobs.items():
            assert len(wanted.holders) <= 2
            assert all(digest in self.fleet.members[holder].leases for holder in wanted.holders)
        for member in self.fleet.members.values():
            assert all(member.identity in self.fleet.jobs[digest].holders for digest in member.leases)

    @invariant()
    def held_background_jobs_are_counted(self):
        held = [each for each in self.fleet.jobs.values() if each.holders and each.work.job.kind != "score"]
        assert self.fleet.jobs._background_held == len(held)

    @invariant()
    def a_result_has_one_verdict_at_most(self):
        assert all(count <= self.received[each] for each, count in self.judged.items())

    @invariant()
    def memory_is_bounded_by_what_is_wanted(self):
        fleet = self.fleet
        assert fleet.jobs._tags.keys() == {digest[:TAG_BYTES] for digest in fleet.jobs}
        queued = [digest for *_, digest in fleet.jobs._queue]
        assert len(queued) == len(set(queued))
        assert len(fleet.members) <= self.lives
        assert set(fleet.jobs._failing) <= set(fleet.jobs)


LOSSLESS = [lossless(number) for number in range(GENERATIONS)]
TestAnyOrder = AnyOrder.TestCase
TestAnyOrder.settings = settings(max_examples=100, stateful_step_count=80)
