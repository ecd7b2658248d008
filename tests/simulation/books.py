"""What must be true of the books of both sides between any two turns; all private state that is read is read here."""

from __future__ import annotations

from collections import Counter

from dreamfleet.common.protocol.messages import TAG_BYTES
from dreamfleet.coordinator.dispatch.fleet import Fleet
from dreamfleet.coordinator.dispatch.packing import SentBatch
from dreamfleet.coordinator.dispatch.pending_jobs import PendingJobs
from dreamfleet.coordinator.run.run import Run
from dreamfleet.worker.service.backlog import MAX_UNUSED_VECTORS
from tests.simulation.violation import Violation
from tests.simulation.worker import Worker

MAX_HOLDERS = 2
MAX_ABSENCES = 1  # beats in a row that have seen a lease's batch and do not show it: the next one ends the lease
# Virtual seconds, each a little longer than the product's own rule, which a wake of either side may overshoot.
SENT_AGAIN_WITHIN = 3.6  # a batch that was not seen, while its coordinator is awake; twice as long each time
MAX_PATIENCE = 16  # times that
REPEATED_WITHIN = 8.6  # a result without a verdict, while its worker is awake
ASKS_WITHIN = 4.0  # a worker that sees another incarnation than it has joined


def check_coordinator(fleet: Fleet) -> None:
    """Leases, queue and counts agree with each other, and nothing is kept that nobody needs."""
    jobs, members = fleet.jobs, fleet.members
    queued = _queued(jobs)
    named = set(queued)
    _require(len(named) == len(queued), "the queue names a job twice")
    is_background = 0
    for digest, each in jobs.items():
        holders = each.holders
        _require((each.queued is not None) == (digest in named), "a job and the queue disagree on whether it is queued")
        waits = each.retry_at > 0 or jobs.checks.get(digest) is each
        _require(bool(holders) or digest in named or waits, "a wanted job is neither held nor queued")
        _require(len(holders) <= MAX_HOLDERS, "a job has more copies than two")
        for holder in holders:
            _require(holder in members, "a job is held by no member")
            _require(digest in members[holder].leases, "a holder has no lease")
        is_background += each.is_background and bool(holders)
    for name, member in members.items():
        _require(name == member.identity, "a member has another's name")
        for digest, lease in member.leases.items():
            _require(lease.absent_heartbeats <= MAX_ABSENCES, "a lease outlives beats that do not show it")
            _require(digest in jobs, "a lease is on a job that nobody wants")
            _require(name in jobs[digest].holders, "a lease is on a job that it does not hold")
        _require(not (member.silent and member.leases), "a silent worker holds leases")
        kinds = Counter((lease.is_background, lease.is_driven) for lease in member.leases.values())
        _require(+member.held == kinds, "a worker's leases are miscounted")
        _require(all(number <= member.number for number in member.unconfirmed), "a batch is unseen that was not sent")
    _require(jobs._background_held == is_background, "what fills the slack is miscounted")
    _require(jobs._tags.keys() == {digest[:TAG_BYTES] for digest in jobs}, "tags are not those of the wanted jobs")
    _require(jobs._failing.keys() <= jobs.keys(), "a job fails that nobody wants")
    checks = jobs.checks.keys()
    _require(checks == {digest for digest in jobs if jobs[digest].check}, "checks are not those that are wanted")
    again = {digest for digest in jobs if jobs[digest].is_control}
    _require(not jobs._accepted.keys() & (jobs.keys() - checks - again), "an accepted job is wanted still")
    _require(all(count >= 0 for count in fleet.counts.values()), "a count is negative")


def check_opening(fleet: Fleet, run: Run) -> None:
    """As a generation opens, the ones before the last are forgotten."""
    oldest = run.generation.number - 1
    _require(
        all(number >= oldest for number in fleet.jobs._accepted.values()), "an old acceptance is remembered", "memory"
    )


def check_credit(fleet: Fleet, send: SentBatch) -> None:
    """A batch with new work fits the credit of its worker; one that is sent again was within it then."""
    member = fleet.members[send.identity]
    if send.work and send.number == member.number and member.unconfirmed[send.number].times == 1:
        _require(len(member.leases) <= 2 * member.capacity, "a worker was given more than its credit", "credit")


class Sendings:
    """When each batch of a coordinator's incarnation was last sent, by the time that it was awake."""

    def __init__(self) -> None:
        self._awake = 0.0
        self._last: dict[tuple[int, int], float] = {}
        self._times: Counter[tuple[int, int]] = Counter()
        self._arrived: dict[int, tuple[int, float]] = {}  # member -> batches that it has seen, and since when

    def pass_by(self, seconds: float) -> None:
        """It was awake for so long."""
        self._awake += seconds

    def sent(self, fleet: Fleet, send: SentBatch) -> None:
        """A batch has left."""
        batch = id(fleet.members[send.identity]), send.number
        self._last[batch] = self._awake
        self._times[batch] += 1

    def check(self, fleet: Fleet) -> None:
        """What a present worker has not seen is sent again before long."""
        for member in fleet.members.values():
            if self._arrived.get(id(member), (-1, 0.0))[0] != member.confirmed:
                self._arrived[id(member)] = member.confirmed, self._awake
            _, free = self._arrived[id(member)]  # its link, of what was sent before
            for number in member.unconfirmed if member.is_reachable else ():
                batch = id(member), number
                quiet = self._awake - max(self._last.get(batch, self._awake), free)
                size = sum(sent.size for sent in member.unconfirmed.values())
                link = member.host_stats.transfer_seconds(size)
                patience = (SENT_AGAIN_WITHIN + link) * min(2 ** (self._times[batch] - 1), MAX_PATIENCE)
                _require(quiet <= patience, "a batch that was not seen is not sent again", "promptness")


def check_sight(worker: Worker, sees: str | None, since: float, now: float) -> None:
    """A worker that sees another incarnation of its coordinator than it has joined says hello."""
    if worker.nonce is not None and sees not in (None, worker.nonce) and not worker.stopped:
        quiet = now - max(since, worker.asked_at, worker.awake_since)
        _require(quiet <= ASKS_WITHIN, "a worker does not join the life that it sees", "promptness")


def check_worker(worker: Worker, now: float) -> None:
    """What it keeps is bounded by what it was given, and what it owes is repeated."""
    held = [job.digest for turn in worker.turns if turn is not None for job, _ in turn.work
            if job.digest not in turn.unwanted]  # fmt: skip
    _require(len(held) == len(set(held)), "a worker scores a job in two slots at once", "waste")
    vectors, queued = len(worker.backlog._vectors), len(worker.backlog.queued)
    just_taken = 2 * worker.capacity  # the next batch drops their vectors
    _require(vectors <= queued + just_taken + MAX_UNUSED_VECTORS, "a worker keeps vectors that no job needs", "memory")
    for digest in worker.outbox.digests if worker.nonce is not None and not worker.asking else ():
        quiet = now - worker.sent_at.get(digest, now)
        _require(quiet <= REPEATED_WITHIN, "a result without a verdict is not repeated", "promptness")


def check_rest(fleet: Fleet, run: Run) -> None:
    """After the last verdict nothing is left of anything but what waits for the run to be resumed."""
    _require(not fleet.lease_count, "a paused fleet holds leases", "memory")
    for member in fleet.members.values():
        _require(not member.unconfirmed, f"{member.identity} has batches that are not seen", "memory")
        _require(not member.verdicts and not member.cancels, f"{member.identity} is owed words", "memory")
    _require(len(run.background_jobs.rollout_collections.uploads) == 0, "an upload is open that nobody sends", "memory")


def check_end(fleet: Fleet, run: Run) -> None:
    """An ended run wants nothing."""
    _require(not fleet.jobs and fleet.lease_count == 0, "an ended run wants jobs", "memory")
    _require(not _queued(fleet.jobs), "queued at the end")
    _require(not fleet.jobs._tags and not fleet.jobs._failing, "an ended run keeps books", "memory")
    _require(len(run.background_jobs.rollout_collections.uploads) == 0, "an upload is open at the end", "memory")


def at_rest(fleet: Fleet, run: Run) -> bool:
    """Whether `check_rest` would find nothing."""
    try:
        check_rest(fleet, run)
    except Violation:
        return False
    return True


def _queued(jobs: PendingJobs) -> list[bytes]:
    queues = (*jobs._queue, *jobs._background_queue)
    return [digest for order, digest in queues if digest in jobs and jobs[digest].queued == order]


def _require(holds: bool, otherwise: str, rule: str = "books") -> None:
    if not holds:
        raise Violation(rule, otherwise)
