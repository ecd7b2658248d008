"""One immutable snapshot of a run; every view reads it and none touches the run.

Taking one costs the same however long the run is. What may be long is cut into pages as it is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache

from dreamfleet.common.host.packages import package_version
from dreamfleet.common.monitoring.status import (
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
from dreamfleet.common.protocol.result_bounds import MAX_SECONDS, clamp_count
from dreamfleet.common.runs.records import StoredEvaluation
from dreamfleet.coordinator.dispatch.event_log import EventLogView
from dreamfleet.coordinator.dispatch.member import Member, episodes_per_second
from dreamfleet.coordinator.dispatch.pending_jobs import JobFailure, shorten
from dreamfleet.coordinator.jobs.generation import CandidateScores
from dreamfleet.coordinator.jobs.history import HistoryView
from dreamfleet.coordinator.run.report import ReportedMean
from dreamfleet.coordinator.run.run import Run

MOST_FAILURES, MOST_NAMED = 3, 3  # failed jobs that are told, and workers of each
LONGEST = 200  # characters of an error
RECENT = 60  # closed generations in the status


@dataclass(frozen=True)
class Snapshot:
    """A run at one moment: its status without heads, and all that the heads and pages are cut from."""

    status: Status
    workers: tuple[WorkerStatus, ...]
    history: HistoryView
    evaluations: tuple[StoredEvaluation, ...]  # the finished ones
    candidate_scores: CandidateScores
    last: CandidateScores | None
    reported: ReportedMean | None
    event_log: EventLogView
    now: float  # of the clock that the story tells time by


def take_snapshot(
    run: Run, name: str, dropped: Mapping[str, int], uptime: float, now: float, expires: float | None = None
) -> Snapshot:
    """The run as it is at `now`, seconds of the monotonic clock; `uptime` in seconds, `expires` since 1970."""
    workers = tuple(_worker(member, now) for member in (*run.worker_protocol.members, *run.worker_protocol.lost))
    candidate_scores = run.generation.candidate_scores()
    status = _status(run, name, candidate_scores, now)
    status = replace(status, uptime=round(uptime, 1), dropped=dict(dropped), expires=expires)
    evaluations = run.background_jobs.evaluations.rows
    return Snapshot(
        status,
        workers,
        run.history.view(),
        evaluations,
        candidate_scores,
        run.last,
        run.background_jobs.report.current,
        run.fleet.event_log.view(),
        now,
    )


def _status(run: Run, name: str, candidate_scores: CandidateScores, now: float) -> Status:
    """The status without heads, and without what only the service knows."""
    present = [member for member in run.worker_protocol.members if member.is_reachable]
    evaluations, failures = run.background_jobs.evaluations, run.worker_protocol.failures
    return Status(
        schema=STATUS_SCHEMA_VERSION,
        run=name,
        run_uid=run.uid,
        incarnation=run.incarnation,
        package=_package(),
        state=run.state,
        why=run.paused or run.ended or "",
        settings=run.settings,
        limits=asdict(run.limits),
        uptime=0.0,
        generation=_open_generation(run, now),
        generations=len(run.history),
        last=run.history.last,
        recent=(),
        population=_empty_population(candidate_scores),
        last_population=None if run.last is None else _empty_population(run.last),
        evaluation=evaluations.last,
        best=evaluations.best,
        evaluations=len(evaluations),
        evaluating=EpisodeProgress(*evaluations.progress),
        collecting=EpisodeProgress(*run.background_jobs.rollout_collections.progress),
        workers=WorkerCount(
            len(present),
            len(run.worker_protocol.members) + len(run.worker_protocol.lost),
            len(run.worker_protocol.lost),
        ),
        worker_list=(),
        slots=sum(member.slots for member in present),
        fingerprint=run.worker_protocol.fingerprint,
        throughput=_throughput(run, present),
        waste=_waste(run.worker_protocol.counts),
        failing=len(failures),
        failures=tuple(_failure(each) for each in failures[:MOST_FAILURES]),
        dropped={},
        refused=_refused(run),
        confirmed=run.confirmed,
        confirming=EpisodeProgress(*run.background_jobs.confirming),
        ending=run.ending,
        closing=0 if run.ended is not None else run.background_jobs.episodes_until_end(ending=run.ending),
        strict=run.worker_protocol.strict,
        classes=run.worker_protocol.classes,
    )


def full_status(snapshot: Snapshot) -> Status:
    """The status with all workers and the last closed generations, for who is bound by no message's length."""
    recent = snapshot.history.part(max(len(snapshot.history) - RECENT, 0), RECENT)
    return replace(snapshot.status, worker_list=snapshot.workers, recent=tuple(recent))


def mark_left(snapshot: Snapshot) -> Snapshot:
    """The last snapshot of a coordinator that leaves its run open."""
    if snapshot.status.state == "ended":
        return snapshot
    return replace(snapshot, status=replace(snapshot.status, state="left"))


def _open_generation(run: Run, now: float) -> GenerationStatus:
    return GenerationStatus(
        number=run.generation.number,
        episodes_done=run.generation.done,
        episodes=run.generation.total,
        seconds=round(max(now - run.opened_at, 0.0), 1),
        sigma=run.sigma,
        temperature=run.generation.spec.temperature,
        stage=_stage(run),
        axis_ratio=None if run.axis_ratio is None else round(run.axis_ratio, 3),
    )


def _stage(run: Run) -> StageStatus | None:
    total, begun = len(run.settings.stages), run.scoring_params.begun
    stage = begun.stage
    if not total:
        return None
    within = stage.horizon, stage.patience, stage.population, stage.episodes, stage.racing
    return StageStatus(stage.number, total, begun.since, *within, stage.driven)


def _empty_population(candidate_scores: CandidateScores) -> Population:
    return Population(candidate_scores.generation, 0, len(candidate_scores.done), (), (), ())


def _throughput(run: Run, present: Sequence[Member]) -> Throughput:
    rate = sum(member.steps_per_second for member in present)
    steps = clamp_count(run.history.steps + run.generation.steps)
    return Throughput(
        steps_per_second=round(rate, 1),
        environment_steps=steps,
        seconds=min(round(run.history.seconds, 1), MAX_SECONDS),
        episodes_per_second=_rounded(episodes_per_second(present, lambda host_stats: host_stats.job_seconds)),
        evaluation_episodes_per_second=_rounded(
            episodes_per_second(present, lambda host_stats: host_stats.evaluation_seconds)
        ),
    )


def _rounded(rate: float | None) -> float | None:
    return None if rate is None else round(rate, 4)


def _refused(run: Run) -> dict[str, str]:
    latest = list(run.worker_protocol.refused_workers.latest.items())[-MOST_NAMED:]
    return {name: shorten(why, LONGEST) for name, why in latest}


def _waste(counts: Mapping[str, int]) -> Waste:
    discarded, accepted = counts["discarded_steps"], counts["accepted_steps"]
    return Waste(
        discarded_steps=clamp_count(discarded),
        share=round(discarded / (discarded + accepted), 4) if discarded else 0.0,
        reissued=counts["reissued"],
        recalled=counts["recalled"],
        copied=counts["copied"],
        duplicate=counts["duplicate"],
        obsolete=counts["obsolete"],
        errors=counts["errors"],
        resent_batches=counts["resent_batches"],
        silences=counts["silences"],
    )


def _failure(failure: JobFailure) -> FailureStatus:
    job, names = failure.work.job, list(failure.errors)[:MOST_NAMED]
    return FailureStatus(
        candidate=f"{job.generation}/{job.candidate}",
        kind=job.kind,
        seeds=job.seeds,
        errors={name: shorten(failure.errors[name], LONGEST) for name in names},
        attempts={name: failure.attempts[name] for name in names},
    )


def _worker(member: Member, now: float) -> WorkerStatus:
    return WorkerStatus(
        worker=member.identity,
        state="lost" if member.gone_since is not None else "silent" if member.silent else "present",
        slots=member.slots,
        leases=len(member.leases),
        finished=member.finished,
        steps_per_second=round(member.steps_per_second, 1) if member.is_reachable else 0.0,
        load=round(member.load, 2),
        drawn_by=member.drawn_by,
        heard=round(now - member.last_heard, 1),
        fingerprint=member.fingerprint,
        job_seconds=None if member.host_stats.job_seconds is None else round(member.host_stats.job_seconds, 4),
        round_trip=None if member.host_stats.round_trip is None else round(member.host_stats.round_trip, 4),
        resent=member.resent,
        host_class=member.host_class,
    )


@cache
def _package() -> str | None:
    """Found out once: it costs 5 ms."""
    return package_version("dreamfleet")
