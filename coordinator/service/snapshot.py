"""An immutable snapshot of a run: every answer about the run is cut from one, and no answer touches the run.

Taking a snapshot costs the same however long the run is. Answers cut what may be long into pages. Pages: decisions.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime

from dreamfleet.common.client.status import (
    STATUS_SCHEMA_VERSION,
    EpisodeProgress,
    FailureStatus,
    GenerationStatus,
    Population,
    StageStatus,
    Status,
    Throughput,
    Waste,
    WorkerCount,
    WorkerStatus,
)
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol.result_bounds import MAX_SECONDS, clamp_count
from dreamfleet.common.runs.records import StoredEvaluation
from dreamfleet.common.schema.times import elapsed_seconds
from dreamfleet.coordinator.dispatch.event_log import FleetEvent
from dreamfleet.coordinator.dispatch.host_stats import HostStats
from dreamfleet.coordinator.dispatch.member import Member
from dreamfleet.coordinator.dispatch.pending_jobs import PendingJob
from dreamfleet.coordinator.jobs.generation import CandidateScores
from dreamfleet.coordinator.jobs.history import HistoryView
from dreamfleet.coordinator.run.report import ReportedMean
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.run.shown_state import shown_state

MOST_FAILURES, MOST_NAMED = 3, 3  # failed jobs in the status, and workers of each
LONGEST = 200  # characters of an error
RECENT = 60  # closed generations in the status


@dataclass(frozen=True)
class Snapshot:
    """A run at one moment."""

    status: Status  # without workers, closed generations and candidates, which may be long
    workers: tuple[WorkerStatus, ...]
    history: HistoryView
    evaluations: tuple[StoredEvaluation, ...]  # the finished ones
    candidate_scores: CandidateScores
    last: CandidateScores | None
    reported: ReportedMean | None
    event_log: tuple[FleetEvent, ...]  # the newest last
    now: float  # seconds of the clock that the event log uses

    def full_status(self) -> Status:
        """The status with all workers and the last closed generations; it may exceed the length of a message."""
        recent = self.history.part(max(len(self.history) - RECENT, 0), RECENT)
        return replace(self.status, worker_list=self.workers, recent=tuple(recent))

    def as_left(self) -> Snapshot:
        """The last snapshot of a coordinator that exits; its run is left open unless it has ended."""
        if self.status.state == "ended":
            return self
        return replace(self, status=replace(self.status, state="left"))


def take_snapshot(
    run: Run, name: str, dropped: Mapping[str, int], uptime: float, now: float, expires: float | None = None,
    score_word: str = "seed",
) -> Snapshot:  # fmt: skip
    """The run at `now`, seconds of the monotonic clock.

    `dropped` counts what the service dropped by reason, `uptime` is in seconds, `expires` in seconds since 1970.
    `score_word` is what the world calls a scored seed.
    """
    background_jobs, candidate_scores = run.background_jobs, run.generation.candidate_scores()
    members = list(run.fleet.members.values())
    departed = [member for worker, member in run.fleet.departed.items() if worker not in run.fleet.members]
    return Snapshot(
        status=_status(run, name, candidate_scores, members, departed, dropped, uptime, now, expires, score_word),
        workers=tuple(_worker(member, now) for member in (*members, *departed)),
        history=run.history.view(),
        evaluations=background_jobs.evaluations.rows,
        candidate_scores=candidate_scores,
        last=run.generations.last,
        reported=background_jobs.report.current,
        event_log=run.fleet.event_log.view(),
        now=now,
    )


def _status(
    run: Run, name: str, candidate_scores: CandidateScores, members: Sequence[Member], departed: Sequence[Member],
    dropped: Mapping[str, int], uptime: float, now: float, expires: float | None, score_word: str,
) -> Status:  # fmt: skip
    present = [member for member in members if member.is_reachable]
    lost = sum(member.is_lost for member in departed)
    shown, reached = shown_state(run), run.state.reached
    evaluations, failures, last = run.background_jobs.evaluations, run.fleet.jobs.failures, run.generations.last
    return Status(
        schema=STATUS_SCHEMA_VERSION,
        run=name,
        run_uid=run.uid,
        incarnation=run.incarnation,
        package=package_version("dreamfleet"),
        state=shown.word,
        why=shown.why,
        pauses=tuple(each.value for each in shown.pauses),
        settings=run.settings,
        limits=asdict(run.limits),
        uptime=round(uptime, 1),
        generation=_open_generation(run),
        generations=len(run.history),
        last=run.history.last,
        recent=(),
        population=_empty_population(candidate_scores),
        last_population=None if last is None else _empty_population(last),
        evaluation=evaluations.last,
        best=evaluations.best,
        evaluations=len(evaluations),
        evaluating=EpisodeProgress(*evaluations.progress),
        collecting=EpisodeProgress(*run.background_jobs.rollout_collections.progress),
        workers=WorkerCount(len(present), len(members) + len(departed), lost, len(departed) - lost),
        worker_list=(),
        slots=sum(member.slots for member in present),
        fingerprint=run.admission.fingerprint,
        throughput=_throughput(run, present),
        waste=_waste(run.fleet.counts),
        failing=len(failures),
        failures=tuple(_failure(each, now) for each in failures[:MOST_FAILURES]),
        dropped=dict(dropped),
        refused=_refused(run),
        confirmed=run.background_jobs.confirmed,
        confirming=EpisodeProgress(*run.background_jobs.confirming),
        ending=reached is not None,
        failed=run.history.failed,
        equal=0 if run.settings.is_external else run.history.equal.count,
        has_risen=run.history.equal.has_risen,
        elapsed=_elapsed(run),
        closing=0 if run.state.ended else run.background_jobs.episodes_until_end(ending=reached is not None),
        strict=run.admission.strict,
        classes=run.journal.results.classes,
        checks=run.verification.summary,
        expires=expires,
        share=run.fleet_share,
        episode_limit=run.episode_limit,
        score_word=score_word,
        archive=None if (archive := run.generations.archive) is None else archive.status,
        open_batches=run.journal.batches.open_count() if run.settings.is_external else 0,
    )


def _elapsed(run: Run) -> float | None:
    """Wall-clock seconds since the run began; `None` if a clock was set so that they cannot be right."""
    seconds = elapsed_seconds(run.created, datetime.now(UTC).isoformat())
    return None if seconds is None else round(min(seconds, MAX_SECONDS), 1)


def _open_generation(run: Run) -> GenerationStatus:
    axis_ratio = run.generations.axis_ratio
    return GenerationStatus(
        number=run.generation.number,
        episodes_done=run.generation.done,
        episodes=run.generation.total,
        seconds=min(round(run.open_seconds, 1), MAX_SECONDS),
        sigma=run.generations.sigma,
        temperature=run.generation.spec.temperature,
        stage=_stage(run),
        axis_ratio=None if axis_ratio is None else round(axis_ratio, 3),
        failed=run.generations.count_failed(run.generation),
    )


def _stage(run: Run) -> StageStatus | None:
    begun = run.generations.begun
    return StageStatus(begun.stage.number, begun.since) if run.settings.stages else None


def _empty_population(candidate_scores: CandidateScores) -> Population:
    return Population(candidate_scores.generation, 0, len(candidate_scores.done), (), (), ())


def _throughput(run: Run, present: Sequence[Member]) -> Throughput:
    rate = sum(member.steps_per_second for member in present)
    steps = clamp_count(run.history.steps + run.generation.steps)
    return Throughput(
        steps_per_second=round(rate, 1),
        environment_steps=steps,
        seconds=min(round(run.history.seconds, 1), MAX_SECONDS),
        episodes_per_second=_episodes_per_second(present, lambda host_stats: host_stats.scoring.mean),
        evaluation_episodes_per_second=_episodes_per_second(present, lambda host_stats: host_stats.evaluation.mean),
    )


def _episodes_per_second(present: Sequence[Member], seconds: Callable[[HostStats], float | None]) -> float | None:
    """Episodes a second of all slots, if a slot takes `seconds` for one; `None` while no worker has shown it.

    Workers that have not shown it yet count like the average of the others.
    """
    slots, rate, shown = 0, 0.0, 0
    for member in present:
        slots += member.slots
        if (each := seconds(member.host_stats)) is not None:
            rate += member.slots / max(each, 1e-6)
            shown += member.slots
    return round(rate * slots / shown, 4) if shown else None


def _refused(run: Run) -> dict[str, str]:
    latest = list(run.admission.refused_workers.latest.items())[-MOST_NAMED:]
    return {name: truncate(why, LONGEST) for name, why in latest}


def _waste(counts: Mapping[str, int]) -> Waste:
    discarded, accepted = counts["discarded_steps"], counts["accepted_steps"]
    shown = "reissued", "recalled", "copied", "duplicate", "obsolete", "errors", "resent_batches", "silences"
    share = round(discarded / (discarded + accepted), 4) if discarded else 0.0
    return Waste(discarded_steps=clamp_count(discarded), share=share, **{name: counts[name] for name in shown})


def _failure(failure: PendingJob, now: float) -> FailureStatus:
    job, errors, attempts = failure.work.job, failure.errors, failure.attempts_by_worker
    names = list(errors)[:MOST_NAMED]
    return FailureStatus(
        candidate=f"{job.generation}/{job.candidate}",
        kind=job.kind,
        seeds=job.seeds,
        errors={name: truncate(errors[name], LONGEST) for name in names},
        attempts={name: attempts[name] for name in names},
        retry_in=round(failure.retry_at - now, 1) if failure.retry_at > now else None,
    )


def _worker(member: Member, now: float) -> WorkerStatus:
    return WorkerStatus(
        worker=member.identity,
        state=_worker_state(member),
        slots=member.slots,
        leases=len(member.leases),
        finished=member.finished,
        steps_per_second=round(member.steps_per_second, 1) if member.is_reachable else 0.0,
        load=round(member.load, 2),
        drawn_by=member.drawn_by,
        heard=round(now - member.last_heard, 1),
        fingerprint=member.fingerprint,
        job_seconds=_rounded(member.host_stats.scoring.mean),
        round_trip=_rounded(member.host_stats.round_trip),
        resent=member.resent,
        host_class=member.host_class,
        reason=member.farewell,
    )


def _worker_state(member: Member) -> str:
    if member.farewell:
        return "left"
    return "lost" if member.gone_since is not None else "silent" if member.silent else "present"


def _rounded(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds, 4)
