"""Run statuses in Prometheus's text exposition format, version 0.0.4. No input or output.

https://prometheus.io/docs/instrumenting/exposition_formats/. The number of series is bounded: only the first
`MAX_WORKERS` workers have their own. Untrusted texts appear as label values only, escaped and shortened.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from dreamfleet.common.monitoring.eta import estimate_eta
from dreamfleet.common.monitoring.status import FINAL_STATES, Status, WorkerStatus
from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol.check_counts import CheckCounts
from dreamfleet.common.runs.records import StoredConfirmation, StoredEvaluation

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
MAX_WORKERS, MAX_REASONS = 200, 50
OTHER_CLASSES = "other"  # label of the host classes that a status does not list
MAX_LABEL_CHARS = 128
STATES = ("running", "evaluating", "waiting for workers", "waiting for a batch", "paused", *FINAL_STATES)
ESCAPES = str.maketrans({"\\": r"\\", '"': r"\"", "\n": r"\n"})


@dataclass(frozen=True)
class Metric:
    """One metric with its samples: a value for each set of labels."""

    name: str
    kind: Literal["gauge", "counter"]
    text: str
    samples: Sequence[tuple[Mapping[str, str], float | None]]  # labels and value; `None` is left out

    @property
    def head(self) -> str:
        """The comment lines before a metric's samples."""
        return f"# HELP {self.name} {self.text}\n# TYPE {self.name} {self.kind}\n"

    def lines(self, run: str) -> Iterator[str]:
        """The lines of its samples, labelled with the run."""
        for labels, value in self.samples:
            if value is not None:
                named = ",".join(f'{name}="{_escape_label(text)}"' for name, text in {"run": run, **labels}.items())
                yield f"{self.name}{{{named}}} {_format_value(value)}\n"


def exposition(*statuses: Status) -> str:
    """All metrics of these runs, each labelled with the run's name."""
    return "".join(_merge_runs(statuses, metrics) for metrics in zip(*map(collect_metrics, statuses), strict=True))


def _merge_runs(statuses: Sequence[Status], metrics: Sequence[Metric]) -> str:
    """One metric of all runs under one head; empty without samples."""
    lines = [line for status, metric in zip(statuses, metrics, strict=True) for line in metric.lines(status.run)]
    return metrics[0].head + "".join(lines) if lines else ""


def collect_metrics(status: Status) -> Iterator[Metric]:
    """All metrics of one run, in the order of the output."""
    yield from _progress(status)
    yield from _fitness(status)
    yield from _fleet(status)
    yield from _waste(status)
    yield from _workers(status.worker_list[:MAX_WORKERS])


def _progress(status: Status) -> Iterator[Metric]:
    opened, spent = status.generation, status.throughput
    states = [({"state": each}, float(each == status.state)) for each in STATES]
    yield Metric("dreamfleet_state", "gauge", "1 for the state that the run is in.", states)
    yield _gauge("generation", "The open generation's number.", opened.number)
    yield _gauge("generation_seconds", "Seconds in which it could be scored.", opened.seconds)
    yield _gauge("generation_episodes_done", "Its episodes that are scored.", opened.episodes_done)
    yield _gauge("generation_episodes", "Its episodes known so far.", opened.episodes)
    yield _counter("generations_closed_total", "Generations that were closed.", status.generations)
    failed = status.failed + opened.failed
    yield _counter("failed_candidates_total", "Candidates of which an episode failed everywhere.", failed)
    yield _counter("environment_steps_total", "Environment steps of candidates.", spent.environment_steps)
    yield _gauge("steps_per_second", "Environment steps a second of the present workers.", spent.steps_per_second)
    eta = estimate_eta(status)
    yield _gauge("pace_seconds", "Seconds a generation, the median of the last ones.", eta.pace)
    yield _gauge("eta_seconds", "Seconds until the run ends, confirmation included.", eta.seconds)
    yield _gauge("uptime_seconds", "Seconds since its coordinator started.", status.uptime)


def _fitness(status: Status) -> Iterator[Metric]:
    last = status.last
    values = [] if last is None else [("mean", last.mean), ("best", last.best), ("worst", last.worst)]
    samples = [({"of": name}, value) for name, value in values]
    yield Metric("dreamfleet_fitness", "gauge", "Fitness of the candidates in the last closed generation.", samples)
    yield _gauge("fitness_deviation", "Standard deviation of their fitness.", None if last is None else last.std)
    yield from _score_gauges("evaluated_score", "Score of the last evaluated mean.", status.evaluation)
    yield from _score_gauges("best_evaluated_score", "Best score of all evaluations; provisional.", status.best)
    yield from _score_gauges(
        "confirmed_score", "Confirmed score of the reported mean, on fresh tracks.", status.confirmed
    )
    sigma = None if status.settings.is_external else status.generation.sigma
    yield _gauge("sigma", "The optimiser's step size.", sigma)
    yield _gauge("temperature", "The open generation's dream temperature.", status.generation.temperature)


def _fleet(status: Status) -> Iterator[Metric]:
    workers = status.workers
    count = [({"which": which}, each) for which, each in (("present", workers.present), ("known", workers.known),
                                                          ("lost", workers.lost))]  # fmt: skip
    text = "Workers that are present, known, or recently lost."
    yield Metric("dreamfleet_workers", "gauge", text, count)
    yield _gauge("slots", "Slots of the present workers.", status.slots)
    classes = status.classes
    rest = classes.results - sum(each.results for each in classes.largest)
    by_class = [({"class": each.host_class}, float(each.results)) for each in classes.largest]
    by_class += [({"class": OTHER_CLASSES}, float(rest))] * bool(rest)
    yield _gauge(
        "host_classes", "Host classes of the accepted results; with one, all results are bit-identical.", classes.total
    )
    yield Metric("dreamfleet_class_results", "gauge", "Accepted results of the largest host classes.", by_class)
    checks = status.checks or CheckCounts(0.0)
    outcomes = {"equal": checks.checked - checks.differing, "differs": checks.differing, "unchecked": checks.unchecked}
    yield _labelled_counter(
        "drawn_results_total", "Results drawn to be scored again on another host.", "outcome", outcomes
    )
    yield _counter("recalled_results_total", "Results of barred hosts that count no more.", checks.recalled)
    why = "Hosts that are barred: their results differ, or the operator says so."
    yield _gauge("barred_hosts", why, len(checks.barred))
    yield _gauge("failing_jobs", "Open jobs that failed on some worker.", status.failing)


def _waste(status: Status) -> Iterator[Metric]:
    waste = status.waste
    yield _counter(
        "discarded_steps_total", "Environment steps of results that were not accepted.", waste.discarded_steps
    )
    jobs = {"reissued": waste.reissued, "recalled": waste.recalled, "copied": waste.copied}
    results = {"duplicate": waste.duplicate, "obsolete": waste.obsolete, "error": waste.errors}
    yield _labelled_counter(
        "jobs_given_again_total", "Jobs assigned to another worker in addition or instead.", "why", jobs
    )
    yield _labelled_counter("results_not_counted_total", "Results that were not accepted.", "why", results)
    yield _counter("resent_batches_total", "Batches that were sent again.", waste.resent_batches)
    yield _counter("silences_total", "Workers that fell silent.", waste.silences)
    dropped = dict(list(status.dropped.items())[:MAX_REASONS])
    yield _labelled_counter("dropped_messages_total", "Messages that were dropped, by reason.", "why", dropped)


def _workers(workers: Sequence[WorkerStatus]) -> Iterator[Metric]:
    def each(name: str, kind: Literal["gauge", "counter"], text: str, values: Sequence[float | None]) -> Metric:
        samples = [({"worker": worker.worker}, value) for worker, value in zip(workers, values, strict=True)]
        return Metric(f"dreamfleet_worker_{name}", kind, text, samples)

    yield each("present", "gauge", "1 unless it is silent or lost.",
               [float(one.state == "present") for one in workers])  # fmt: skip
    yield each("slots", "gauge", "Its slots.", [one.slots for one in workers])
    yield each("leases", "gauge", "Jobs assigned to it.", [one.leases for one in workers])
    yield each("finished_total", "counter", "Its results that were accepted.", [one.finished for one in workers])
    yield each("steps_per_second", "gauge", "Environment steps a second.", [one.steps_per_second for one in workers])
    yield each("job_seconds", "gauge", "Seconds of a candidate's job in a slot.", [w.job_seconds for w in workers])
    yield each(
        "round_trip_seconds", "gauge", "Upper bound of its network round trip.", [one.round_trip for one in workers]
    )
    yield each("resent_batches_total", "counter", "Batches sent to it again.", [one.resent for one in workers])
    yield each("load", "gauge", "Its host's load over a minute.", [one.load for one in workers])
    yield each("heard_seconds", "gauge", "Seconds since its last message.", [one.heard for one in workers])


def _score_gauges(name: str, text: str, found: StoredEvaluation | StoredConfirmation | None) -> Iterator[Metric]:
    yield _gauge(name, text, None if found is None else found.mean)
    yield _gauge(f"{name}_error", f"Standard error of {name}.", None if found is None else found.error)


def _gauge(name: str, text: str, value: float | None) -> Metric:
    return Metric(f"dreamfleet_{name}", "gauge", text, [({}, value)])


def _counter(name: str, text: str, value: float) -> Metric:
    return Metric(f"dreamfleet_{name}", "counter", text, [({}, value)])


def _labelled_counter(name: str, text: str, label: str, values: Mapping[str, float]) -> Metric:
    return Metric(f"dreamfleet_{name}", "counter", text, [({label: key}, value) for key, value in values.items()])


def _escape_label(text: str) -> str:
    return truncate(text, MAX_LABEL_CHARS).translate(ESCAPES)


def _format_value(value: float) -> str:
    return repr(float(value))
