"""What evaluations get of a busy fleet, simulated: whole fleets, FIFO slots, no transport and no real time."""

import heapq

import pytest
from msgspec.structs import replace

from dreamfleet.common.protocol.messages import Result
from dreamfleet.coordinator.dispatch.deficit_round_robin import OUTLIER, DeficitCounter
from tests.support.dispatched import A, B, Fleet, beat, fleet_of, join, work


class Simulated:
    """Workers of so many slots that do jobs in order; a job takes its kind's seconds, a generation its jobs.

    As a generation opens, `evaluations` says how many episodes of an evaluation begin.
    """

    def __init__(self, workers, slots, jobs, seconds, width=1, evaluations=lambda generation: 0, **how):
        self.fleet = Fleet(1.0, **how)
        self.slots, self.jobs, self.seconds, self.width = slots, jobs, seconds, width
        self.evaluations = evaluations
        self.now, self.generation = 0.0, 0
        self.spent = {"score": 0.0, "evaluate": 0.0}
        self.closed = []  # when each generation was
        self.done = {}  # generation of the mean -> when its evaluation was finished
        self._open = {}
        self._events = []  # when a slot is free again: (time, serial, worker, results)
        self._serial = 0
        self._backlog = {f"w{number}/00000001": [] for number in range(workers)}
        self._running = {name: [] for name in self._backlog}
        for name in self._backlog:
            self.fleet.add_worker(name, slots, "f", 0.0)
        self._beat_at = 0.0

    def run(self, until):
        """Until so many generations are closed."""
        self._offer()
        while len(self.closed) < until:
            self._give()
            self.now = self._events[0][0]
            while self._events and self._events[0][0] == self.now:
                _, _, name, turn = heapq.heappop(self._events)
                self._running[name].remove(turn)
                for job in turn:
                    self._end(name, job)

    def _end(self, name, job):
        self.spent[job.kind] += self.seconds[job.kind]
        result = Result(job.digest, 1.0, 10, self.seconds[job.kind], None, None)
        if self.fleet.handle_result(name, result, self.now)[0] == "accepted":  # and no copy
            self._count(job)

    def _count(self, job):
        if job.kind == "score":
            self._left -= 1
        else:
            self._open[job.generation].discard(job.digest)
            if not self._open[job.generation]:
                self.done[job.generation] = self.now
        if self._left == 0 and job.kind == "score":
            self.closed.append(self.now)
            self.generation += 1
            if episodes := self.evaluations(self.generation):
                evaluation = work(episodes, "evaluate", self.generation)
                self._open[self.generation] = {each.job.digest for each in evaluation}
                self.fleet.jobs.offer(evaluation)
            self.fleet.jobs.begin_generation(self.generation)
            self._offer()

    def _offer(self):
        self.fleet.jobs.offer(work(self.jobs, generation=self.generation))
        self._left = self.jobs

    def _give(self):
        if self.now >= self._beat_at:
            self._beat()
        for send in self.fleet.dispatch(self.now):
            backlog, cancels = self._backlog[send.identity], set(send.cancels)
            backlog += [each.job for each in send.work]
            backlog[:] = [job for job in backlog if job.digest not in cancels]
        for name, backlog in self._backlog.items():
            while backlog and len(self._running[name]) < self.slots:
                turn = [backlog.pop(0)]
                while turn[0].kind == "score" and len(turn) < self.width and backlog and backlog[0].kind == "score":
                    turn.append(backlog.pop(0))
                self._running[name].append(turn)
                self._serial += 1
                spent = sum(self.seconds[job.kind] for job in turn)
                heapq.heappush(self._events, (self.now + spent, self._serial, name, turn))

    def _beat(self):
        """Everything that was given is held; batches are seen."""
        self._beat_at = self.now + 1.0
        for name, backlog in self._backlog.items():
            running = [job.digest for turn in self._running[name] for job in turn]
            queued = [job.digest for job in backlog]
            seen = self.fleet.members[name].number
            shown = beat(self.slots * self.width, seen, queued=queued, running=running, steps=1)
            self.fleet.handle_heartbeat(name, replace(shown, slots=self.slots), self.now)


EVEN = {"score": 1.0, "evaluate": 1.0}
CUT = {"score": 0.3, "evaluate": 1.0}  # training episodes are cut by patience
DREAMT = {"score": 0.01, "evaluate": 1.0}


@pytest.mark.parametrize(
    ("workers", "slots", "jobs", "seconds", "width", "episodes"),
    [
        (2, 1, 256, EVEN, 1, 32),  # as it was reported
        (1, 1, 256, EVEN, 1, 32),
        (1, 1, 256, CUT, 1, 32),
        (1, 2, 2048, DREAMT, 256, 10),
        (2, 8, 512, CUT, 1, 40),
        pytest.param(125, 8, 2500, EVEN, 1, 100, marks=pytest.mark.slow),
    ],
    ids=["two slots", "one slot", "one slot, cut", "dreams", "sixteen slots", "a thousand slots"],
)
def test_an_evaluation_is_finished_within_two_generations(workers, slots, jobs, seconds, width, episodes):
    fleet = Simulated(workers, slots, jobs, seconds, width, lambda generation: episodes * (generation % 3 == 0))
    fleet.run(until=8)
    assert sorted(fleet.done) == [3, 6]
    for generation, done in fleet.done.items():
        assert done <= fleet.closed[generation + 1], "within two generations after the one whose mean it is"


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5])
@pytest.mark.parametrize("seconds", [EVEN, CUT, DREAMT], ids=["even", "cut", "dreamt"])
@pytest.mark.parametrize(("workers", "slots"), [(1, 1), (2, 2)])
def test_while_evaluations_wait_they_have_their_share_of_the_slots_time(workers, slots, seconds, share):
    """Measured in seconds of the slots; more always wait than the share allows."""
    jobs = min(int(150 * workers * slots / seconds["score"]), 2500)
    fleet = Simulated(
        workers, slots, jobs, seconds, evaluations=lambda _: 1000 * workers * slots, evaluation_share=share
    )
    fleet.run(until=1)
    before = dict(fleet.spent)
    fleet.run(until=2)
    spent = {kind: fleet.spent[kind] - before[kind] for kind in before}
    job = 2 * workers * slots * seconds["evaluate"] / sum(spent.values())  # what is in hand, at either end
    assert spent["evaluate"] / sum(spent.values()) == pytest.approx(share, abs=0.02 + job)


def test_what_was_not_used_is_not_saved_up():
    """After many generations without an evaluation, one takes its share and not the fleet."""
    fleet = Simulated(2, 1, 256, EVEN, evaluations=lambda generation: 1000 * (generation == 12))
    fleet.run(until=13)
    assert 256 / 3 - 4 <= fleet.spent["evaluate"] <= 256 / 3 + 4
    assert fleet.closed[12] - fleet.closed[11] <= 128 * 4 / 3 + 4


def test_without_a_share_they_take_what_is_idle():
    fleet = Simulated(2, 1, 256, EVEN, evaluations=lambda generation: 32 * (generation % 4 == 0), evaluation_share=0.0)
    fleet.run(until=8)
    assert fleet.spent["evaluate"] <= 4


def test_a_suspended_host_neither_starves_nor_floods():
    share = DeficitCounter(0.25)
    for _ in range(20):
        share.charge(b"s", 1.0, is_background=False, waiting=True)
    share.reserve(b"e")
    share.charge(b"e", 1.0, is_background=True, waiting=True)
    share.reserve(b"f")
    share.charge(b"f", 3600.0, is_background=True, waiting=True)
    for _ in range(4 * OUTLIER):
        share.charge(b"s", 1.0, is_background=False, waiting=True)
    assert share.is_due(1)
    share.charge(b"s", 3600.0, is_background=False, waiting=True)
    went = 0
    while share.is_due(1):
        share.reserve(bytes([went]))
        went += 1
    assert went <= 2 * OUTLIER


def test_a_lost_workers_evaluation_goes_again_at_once():
    fleet = fleet_of(A, jobs=0)
    fleet.jobs.offer([*work(1, "evaluate"), *work(9, generation=1)])
    assert [each.job.kind for send in fleet.dispatch(0.0) for each in send.work] == ["evaluate", "score"]
    fleet.handle_departure(A, 0.1)
    fleet.tick(1.0)
    join(fleet, B, 1.0)
    assert [each.job.kind for send in fleet.dispatch(1.0) for each in send.work] == ["evaluate", "score"]
