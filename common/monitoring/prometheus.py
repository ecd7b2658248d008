"""A run's status as Prometheus reads it: the text exposition format, version 0.0.4. Pure.

https://prometheus.io/docs/instrumenting/exposition_formats/. Label sets are bounded, whatever the run: texts of others
are label values only, escaped and shortened, and of workers the first `MOST_WORKERS` have series of their own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from dreamfleet.common.monitoring.eta import estimate_eta
from dreamfleet.common.monitoring.status import FINAL_STATES, Status, WorkerStatus
from dreamfleet.common.printable import truncate
from dreamfleet.common.runs.records import StoredConfirmation, StoredEvaluation

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
MAX_WORKERS, MAX_REASONS = 200, 50
OTHER_CLASSES = "other"  # the classes of hosts that a status does not name
LONGEST = 128  # characters of a label's value
STATES = ("running", "evaluating", "waiting for workers", "paused", *FINAL_STATES)
ESCAPES = str.maketrans({"\\": r"\\", '"': r"\"", "\n": r"\n"})


@dataclass(frozen=True)
class Metric:
    """One metric with its samples: a value for each set of labels."""

    name: str
    kind: Literal["gauge", "counter"]
    text: str
    samples: Sequence[tuple[Mapping[str, str], float | None]]  # `None`: it has none

    @property
    def head(self) -> str:
        """What stands once before its lines, of however many runs these are."""
        return f"# HELP {self.name} {self.text}\n# TYPE {self.name} {self.kind}\n"

    def lines(self, run: str) -> Iterator[str]:
        """As they are written; nothing for a metric without a value."""
        for labels, value in self.samples:
            if value is not None:
                named = ",".join(f'{name}="{_escape_label(text)}"' for name, text in {"run": run, **labels}.items())
                yield f"{self.name}{{{named}}} {_format_value(value)}\n"


def exposition(*statuses: Status) -> str:
    """All metrics of these runs, each labelled with the run's name."""
    return "".join(_merge_runs(statuses, of_each) for of_each in zip(*map(collect_metrics, statuses), strict=True))


def _merge_runs(statuses: Sequence[Status], of_each: Sequence[Metric]) -> str:
    """One metric, of each run."""
    lines = [line for status, metric in zip(statuses, of_each, strict=True) for line in metric.lines(status.run)]
    return of_each[0].head + "".join(lines) if lines else ""


def collect_metrics(status: Status) -> Iterator[Metric]:
    """In the order in which they are written."""
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
    yield _gauge("generation_seconds", "Seconds since it was opened.", opened.seconds)
    yield _gauge("generation_episodes_done", "Its episodes that are scored.", opened.episodes_done)
    yield _gauge("generation_episodes", "Its episodes, as far as that is known.", opened.episodes)
    yield _counter("generations_closed_total", "Generations that were closed.", status.generations)
    yield _counter("environment_steps_total", "Environment steps of candidates.", spent.environment_steps)
    yield _gauge("steps_per_second", "Environment steps a second of the present workers.", spent.steps_per_second)
    eta = estimate_eta(status)
    yield _gauge("pace_seconds", "Seconds a generation, the median of the last ones.", eta.pace)
    yield _gauge("eta_seconds", "Seconds until the run ends, its confirmation among them.", eta.seconds)
    yield _gauge("uptime_seconds", "Seconds since its coordinator began.", status.uptime)


def _fitness(status: Status) -> Iterator[Metric]:
    last = status.last
    told = [] if last is None else [("mean", last.mean), ("best", last.best), ("worst", last.worst)]
    samples = [({"of": name}, value) for name, value in told]
    yield Metric("dreamfleet_fitness", "gauge", "Of the candidates of the generation closed last.", samples)
    yield _gauge("fitness_deviation", "Standard deviation of their fitness.", None if last is None else last.std)
    yield from _score_gauges("evaluated_score", "Of the mean that was evaluated last.", status.evaluation)
    yield from _score_gauges("best_evaluated_score", "The best of all evaluations; provisional.", status.best)
    yield from _score_gauges("confirmed_score", "Of what is reported, on fresh tracks.", status.confirmed)
    yield _gauge("sigma", "The strategy's step size.", status.generation.sigma)
    yield _gauge("temperature", "At which the open generation dreams.", status.generation.temperature)


def _fleet(status: Status) -> Iterator[Metric]:
    workers = status.workers
    count = [({"which": which}, each) for which, each in (("present", workers.present), ("known", workers.known),
                                                          ("lost", workers.lost))]  # fmt: skip
    told = "Workers that are present, that are known, and that vanished without a word in the last minutes."
    yield Metric("dreamfleet_workers", "gauge", told, count)
    yield _gauge("slots", "Slots of the present workers.", status.slots)
    classes = status.classes
    rest = classes.results - sum(each.results for each in classes.largest)
    by_class = [({"class": each.host_class}, float(each.results)) for each in classes.largest]
    by_class += [({"class": OTHER_CLASSES}, float(rest))] * bool(rest)
    yield _gauge("host_classes", "Classes of hosts that accepted results are of; one: to the bit.", classes.total)
    yield Metric("dreamfleet_class_results", "gauge", "Accepted results of the largest classes of hosts.", by_class)
    yield _gauge("failing_jobs", "Wanted jobs that failed somewhere.", status.failing)


def _waste(status: Status) -> Iterator[Metric]:
    waste = status.waste
    yield _counter("discarded_steps_total", "Environment steps done twice or for nothing.", waste.discarded_steps)
    jobs = {"reissued": waste.reissued, "recalled": waste.recalled, "copied": waste.copied}
    results = {"duplicate": waste.duplicate, "obsolete": waste.obsolete, "error": waste.errors}
    yield _labelled_counter("jobs_given_again_total", "Jobs given to another worker too, or instead.", "why", jobs)
    yield _labelled_counter("results_not_counted_total", "Results that were not accepted.", "why", results)
    yield _counter("resent_batches_total", "Batches that were sent again.", waste.resent_batches)
    yield _counter("silences_total", "Workers that fell silent.", waste.silences)
    dropped = dict(list(status.dropped.items())[:MAX_REASONS])
    yield _labelled_counter("dropped_messages_total", "Messages that were dropped, by reason.", "why", dropped)


def _workers(workers: Sequence[WorkerStatus]) -> Iterator[Metric]:
    def each(name: str, kind: Literal["gauge", "counter"], text: str, values: Sequence[float | None]) -> Metric:
        samples = [({"worker": worker.worker}, value) for worker, value in zip(workers, values, strict=True)]
        return Metric(f"dreamfleet_worker_{name}", kind, text, samples)

    yield each("present", "gauge", "1 while it is neither silent nor lost.",
               [float(one.state == "present") for one in workers])  # fmt: skip
    yield each("slots", "gauge", "Its slots.", [one.slots for one in workers])
    yield each("leases", "gauge", "Jobs in its hands.", [one.leases for one in workers])
    yield each("finished_total", "counter", "Its results that were accepted.", [one.finished for one in workers])
    yield each("steps_per_second", "gauge", "Environment steps a second.", [one.steps_per_second for one in workers])
    yield each("job_seconds", "gauge", "Seconds that a candidate's job takes a slot.", [w.job_seconds for w in workers])
    yield each("round_trip_seconds", "gauge", "Bound of its network's round trip.", [one.round_trip for one in workers])
    yield each("resent_batches_total", "counter", "Batches sent to it again.", [one.resent for one in workers])
    yield each("load", "gauge", "Its host's load over a minute.", [one.load for one in workers])
    yield each("heard_seconds", "gauge", "Seconds since it was heard.", [one.heard for one in workers])


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
    return truncate(text, LONGEST).translate(ESCAPES)


def _format_value(value: float) -> str:
    return repr(float(value))
