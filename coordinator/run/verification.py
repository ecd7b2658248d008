"""A share of a run's accepted results is scored again on another host and compared, and who differs is barred.

R32: which results are drawn follows from a secret of the run, so no worker can know. What is accepted does not depend
on the draw. A generation, and an evaluation, waits for its checks as long as a host is here that can answer.
`coordinator/jobs/checks.py` decides who is wrong, `recall.py` takes results back, and the simulation plays both with
liars (`tests/simulation/test_liars.py`). Pages: status.md, threats.md, decisions.md.
"""

import hmac
from collections.abc import Iterable
from dataclasses import dataclass

from dreamfleet.common.printable import printable
from dreamfleet.common.protocol.check_counts import CheckCounts
from dreamfleet.common.protocol.failures import describe_job
from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.protocol.messages import Job, Result
from dreamfleet.coordinator.dispatch.fleet import Fleet
from dreamfleet.coordinator.dispatch.member import Member
from dreamfleet.coordinator.dispatch.pending_jobs import PendingJob
from dreamfleet.coordinator.jobs.checks import Answer, Check, Decision, decide
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob
from dreamfleet.coordinator.run.admission import WorkerAdmission
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.coordinator.storage.verification_records import Outcome, StoredBar

MOST_NAMED = 6  # answers that a message names


@dataclass(frozen=True)
class _Finding:
    """What came of checking a job's result, that `worker` brought."""

    job: Job
    worker: str
    checkers: str  # hosts
    outcome: Outcome
    decision: Decision
    what: str  # which hosts gave what, in words


class Verification:
    """Checks the share `share` of a run's accepted results; 0 checks none, and keeps barred hosts out all the same."""

    def __init__(
        self, journal: Journal, fleet: Fleet, admission: WorkerAdmission, share: float, incarnation: int
    ) -> None:
        self.share = share
        self.counts = journal.verification.counts()
        self._journal = journal
        self._fleet = fleet
        self._jobs = fleet.jobs
        self._admission = admission
        self._incarnation = incarnation
        self._answers: dict[bytes, list[Answer]] = {}  # to each open check, the accepted result's first
        self._workers: dict[bytes, str] = {}  # whose result was accepted
        self._held: dict[bytes, frozenset[str]] = {}  # checks that only a further voter can decide, with theirs
        self._due_since: dict[bytes, float] = {}
        self._findings: dict[bytes, _Finding] = {}  # checks that found hosts wrong, before these are barred
        if share:
            self._key = journal.verification.key()
            fleet.jobs.is_drawn = self.is_drawn

    def is_drawn(self, work: ScoringJob) -> bool:
        """Whether a job's accepted result is to be checked. Kept rollouts are not: no fitness depends on them."""
        if not self.share or work.kind == "collect":
            return False
        number = int.from_bytes(hmac.digest(self._key, work.digest, "sha256")[:8], "big")
        return number < self.share * 2**64

    @property
    def summary(self) -> CheckCounts | None:
        """What came of it so far; `None` if nothing is checked and nobody is barred."""
        bars = ((host, bar.by_operator) for host, bar in self._admission.barred.items())
        return CheckCounts.of(self.share, self.counts, bars, self.waiting)

    @property
    def holds_generation(self) -> bool:
        """Whether a candidate's job of the open generation waits for its check."""
        return any(each.work.kind == "score" for each in self._jobs.checks.values())

    @property
    def waiting(self) -> str:
        """Which hosts differ, so that a further one must decide, in words; empty if none do."""
        digest = next((each for each in self._held if each in self._jobs.checks), None)
        return "" if digest is None else self._describe(digest)

    def is_checking(self, digests: Iterable[bytes]) -> bool:
        """Whether the accepted result of any of these jobs waits for its check."""
        return bool(self._jobs.checks) and any(digest in self._jobs.checks for digest in digests)

    def note_accepted(self, job: Job, result: Result, worker: str) -> None:
        """Note the accepted result of a job; of a drawn one, to compare it."""
        if job.digest in self._jobs.checks:
            self._answers[job.digest] = [self._answer(worker, result)]
            self._workers[job.digest] = worker

    def restore(self, work: Iterable[ScoringJob]) -> None:
        """Check again what an earlier incarnation of the coordinator accepted and did not check."""
        if not self.share:
            return
        drawn = {each.digest: each for each in work if each.digest not in self._jobs and self.is_drawn(each)}
        for digest, known in self._journal.verification.unverified([each.job for each in drawn.values()]).items():
            voter = self._jobs.voter_of(known.worker)
            self._jobs.offer_check(drawn[digest], Check(known.host_class, {voter}))
            self._answers[digest] = [Answer(host_of(known.worker), voter, *known.value, known.seconds)]
            self._workers[digest] = known.worker

    def keep_to(self, counted: Iterable[ScoringJob]) -> None:
        """Check no candidate's result but those of these jobs: others count no more."""
        digests = {each.digest for each in counted}
        checked = [(digest, each.work.kind) for digest, each in self._jobs.checks.items()]
        self._fleet.leases.withdraw(digest for digest, kind in checked if kind == "score" and digest not in digests)

    def record(self, work: ScoringJob, result: Result, worker: str) -> None:
        """Compare a result of a job whose result was accepted before; a repeated message changes nothing."""
        answers, answer = self._answers[work.digest], self._answer(worker, result)
        if answer not in answers and work.digest not in self._findings:
            answers.append(answer)
            self._decide(self._jobs.checks[work.digest])

    def _answer(self, worker: str, result: Result) -> Answer:
        return Answer.of(host_of(worker), self._jobs.voter_of(worker), result)

    def settle(self, now: float) -> None:
        """Let checks wait no longer for hosts that are not here, or that do not answer."""
        if self._findings:
            return
        if self._fleet.paused:
            self._due_since.clear()
            return
        self._forget(*(self._answers.keys() - self._jobs.checks.keys()))  # jobs that were withdrawn
        for worker in self._fleet.members.values():
            worker.is_held = any(self._jobs.voter_of(worker.identity) in held for held in self._held.values())
        is_scoring = any(each.work.kind == "score" and each.check is None for each in self._jobs.values())
        for digest, pending in list(self._jobs.checks.items()):
            job = pending.work.job
            if is_scoring and job.kind == "score":
                continue  # a host may still come while the generation is open
            since = self._due_since.setdefault(digest, now)
            if now - since > self._fleet.speculation.longest_held(is_background=job.kind != "score"):
                self._pass_over(pending, now)
            elif not pending.holders and not self._can_be_asked(pending):
                self._decide(pending)

    def resume(self) -> None:
        """Somebody resumed the run: compare again where hosts differed and nobody decided."""
        for digest in [each for each in self._held if each in self._jobs.checks]:
            pending, first = self._jobs.checks[digest], self._answers[digest][0]
            assert pending.check is not None
            self._answers[digest] = [first]
            del self._held[digest]
            self._due_since.pop(digest, None)
            self._fleet.leases.check_again(pending, Check(pending.check.host_class, {first.voter}))

    def _can_be_asked(self, pending: PendingJob) -> bool:
        check = pending.check
        return check is not None and any(
            check.may_ask(self._jobs.voter_of(each.identity), each.host_class) for each in self._scoring_members()
        )

    def _scoring_members(self) -> list[Member]:
        return [each for each in self._fleet.members.values() if each.can_score]

    def _pass_over(self, pending: PendingJob, now: float) -> None:
        """Ask those who have the job no more: they took too long."""
        assert pending.check is not None
        digest = pending.work.digest
        check, late = pending.check, set(map(self._jobs.voter_of, pending.holders))
        self._due_since[digest] = now
        if digest in self._held and late:
            self._fleet.leases.check_again(pending, Check(check.host_class, check.answered, check.passed_over | late))
        elif digest not in self._held:
            check.passed_over |= late
            self._decide(pending)

    def _decide(self, pending: PendingJob) -> None:
        """Go on as the answers so far say."""
        digest, check = pending.work.digest, pending.check
        assert check is not None
        answers = self._answers[digest]
        able = [each for each in self._scoring_members() if each.host_class == check.host_class]
        present = {self._jobs.voter_of(each.identity) for each in able} - check.passed_over
        answered = {each.voter for each in answers}
        trusted = {self._jobs.voter_of(name) for name, each in self._fleet.members.items() if each.is_trusted}
        decision = decide(answers, present, bool(present - answered), trusted)
        if decision.ask_other or decision.ask_again:
            only = decision.ask_again or None
            self._fleet.leases.check_again(pending, Check(check.host_class, answered, check.passed_over, only))
        elif decision.held or (
            decision.by_trusted and any(each.by_trusted for each in self._admission.barred.values())
        ):
            self._hold(pending, answered)
        else:
            self._finish(pending, decision)

    def _hold(self, pending: PendingJob, voters: set[str]) -> None:
        """Neither is believed until a further one answers; that one is asked as soon as it comes."""
        digest, check = pending.work.digest, pending.check
        assert check is not None
        if self._held.get(digest, frozenset()) != frozenset(voters):
            self._held[digest] = frozenset(voters)
            self._fleet.leases.check_again(pending, Check(check.host_class, set(voters)))
            self._fleet.note(self.waiting, "differing")

    def _finish(self, pending: PendingJob, decision: Decision) -> None:
        """Write what came of a check; if hosts are wrong, keep it until `condemn` bars them."""
        job, answers = pending.work.job, self._answers[pending.work.digest]
        values = {each.value for each in answers}
        outcome: Outcome = "differs" if len(values) > 1 else "equal" if len(answers) > 1 else "unchecked"
        checkers = ",".join(sorted({each.host for each in answers} - {answers[0].host}))
        found = _Finding(job, self._workers[job.digest], checkers, outcome, decision, self._describe_values(job.digest))
        if decision.wrong:
            self._findings[job.digest] = found
            return
        self._write(found)
        if outcome == "differs":
            text = f"{found.what}; none gives the same twice, so the task is not deterministic there"
            self._fleet.note(text, "unsteady")
        self._fleet.leases.withdraw([job.digest])
        self._forget(job.digest)

    def _forget(self, *digests: bytes) -> None:
        """Keep nothing of checks that are over."""
        for kept in (self._answers, self._workers, self._held, self._due_since):
            for digest in digests:
                kept.pop(digest, None)

    @property
    def has_findings(self) -> bool:
        """Whether hosts were found wrong: `condemn` bars them, and the run must be rewound in the same transaction."""
        return bool(self._findings)

    def condemn(self) -> set[str]:
        """Bar the hosts that were found wrong, in the journal too; their names."""
        hosts: set[str] = set()
        for found in self._findings.values():
            self._write(found)
            for host in self._admission.hosts_of(found.decision.wrong):
                by_trusted = found.decision.by_trusted
                witness = "the coordinator's own host" if by_trusted else "another host"
                why = f"{found.what}; {witness} confirms that {printable(host)} is wrong"
                hosts |= self._admission.bar(host, StoredBar(why, by_trusted), self._incarnation)
        self._findings.clear()
        return hosts

    def _write(self, found: _Finding) -> None:
        self._journal.verification.add(found.job, found.worker, found.checkers, found.outcome)
        self.counts[found.outcome] += 1

    def _describe_values(self, digest: bytes) -> str:
        """What each host gave for a job, in words."""
        job, answers = self._jobs.checks[digest].work.job, self._answers[digest]
        given = ", ".join(f"{printable(each.host)} gave {each.fitness!r}" for each in answers[:MOST_NAMED])
        return f"hosts differ in {describe_job(job.kind, job.generation, job.candidate, job.seeds)}: {given}"

    def _describe(self, digest: bytes) -> str:
        """Which hosts wait for a further one, and what to do."""
        return (
            f"{self._describe_values(digest)}; neither gets further jobs until another host of their class scores it: "
            "start a worker on one, in a secured fleet with a join file of its own, or on the "
            "coordinator's own host; `dreamfleet resume` compares them again"
        )
