"""Run statuses as Prometheus's text, written by `prometheus_client`. No input or output.

The number of series is bounded: only the first `MAX_WORKERS` workers have their own. Untrusted texts appear as label
values only, shortened. `deploy/grafana/dreamfleet.json` draws these. Pages: decisions.md.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import generate_latest
from prometheus_client.registry import Collector

from dreamfleet.common.client.run_view import LiveRunView
from dreamfleet.common.client.status import FINAL_STATES, Status, WorkerStatus
from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol.check_counts import CheckCounts
from dreamfleet.common.runs.records import StoredConfirmation, StoredEvaluation

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
MAX_WORKERS, MAX_REASONS = 200, 50
OTHER_CLASSES = "other"  # label of the host classes that a status does not list
MAX_LABEL_CHARS = 128
# As `coordinator/run/shown_state.py` names them.
STATES = ("running", "evaluating", "waiting for workers", "waiting for a batch", "paused", *FINAL_STATES)


def exposition(*statuses: Status) -> bytes:
    """All metrics of these runs, each labelled with the run's name."""
    return generate_latest(_Runs(statuses))


class _Runs(Collector):
    """The metrics of some runs, each under one head."""

    def __init__(self, statuses: Sequence[Status]) -> None:
        self._statuses = statuses

    def collect(self) -> Iterator[Metric]:
        """Each metric that has a sample."""
        for metrics in zip(*map(collect_metrics, self._statuses), strict=True):
            merged = metrics[0]
            merged.samples = [
                sample._replace(labels={"run": truncate(status.run, MAX_LABEL_CHARS), **sample.labels})
                for status, metric in zip(self._statuses, metrics, strict=True)
                for sample in metric.samples
            ]
            if merged.samples:
                yield merged


def collect_metrics(status: Status) -> Iterator[Metric]:
    """All metrics of one run, in the order of the output, also those without a sample."""
    yield from _progress(status)
    yield from _fitness(status)
    yield from _fleet(status)
    yield from _waste(status)
    yield from _workers(status.worker_list[:MAX_WORKERS])


def _progress(status: Status) -> Iterator[Metric]:
    opened, spent, view = status.generation, status.throughput, LiveRunView.of_status(status)
    states = {each: each == status.state for each in STATES}
    yield _metric("state", "1 for the state that the run is in.", states, "state")
    yield _metric("generation", "The open generation's number.", opened.number)
    yield _metric("generation_seconds", "Seconds in which it could be scored.", opened.seconds)
    yield _metric("generation_episodes_done", "Its episodes that are scored.", opened.episodes_done)
    yield _metric("generation_episodes", "Its episodes known so far.", opened.episodes)
    yield _metric("generations_closed_total", "Generations that were closed.", status.generations)
    yield _metric("failed_candidates_total", "Candidates of which an episode failed everywhere.", view.failed)
    yield _metric("environment_steps_total", "Environment steps of candidates.", spent.environment_steps)
    yield _metric("steps_per_second", "Environment steps a second of the present workers.", spent.steps_per_second)
    yield _metric("pace_seconds", "Seconds a generation, the median of the last ones.", view.eta.pace)
    yield _metric("eta_seconds", "Seconds until the run ends, confirmation included.", view.eta.seconds)
    yield _metric("uptime_seconds", "Seconds since its coordinator started.", status.uptime)


def _fitness(status: Status) -> Iterator[Metric]:
    last = status.last
    values = {} if last is None else {"mean": last.mean, "best": last.best, "worst": last.worst}
    yield _metric("fitness", "Fitness of the candidates in the last closed generation.", values, "of")
    yield _metric("fitness_deviation", "Standard deviation of their fitness.", None if last is None else last.std)
    yield from _score("evaluated_score", "Score of the last evaluated mean.", status.evaluation)
    yield from _score("best_evaluated_score", "Best score of all evaluations; provisional.", status.best)
    yield from _score("confirmed_score", "Confirmed score of the reported mean, on fresh tracks.", status.confirmed)
    sigma = None if status.settings.is_external else status.generation.sigma
    yield _metric("sigma", "The optimiser's step size.", sigma)
    yield _metric("temperature", "The open generation's dream temperature.", status.generation.temperature)


def _fleet(status: Status) -> Iterator[Metric]:
    workers = status.workers
    count = {"present": workers.present, "known": workers.known, "lost": workers.lost}
    yield _metric("workers", "Workers that are present, known, or recently lost.", count, "which")
    yield _metric("slots", "Slots of the present workers.", status.slots)
    classes = status.classes
    by_class = {each.host_class: each.results for each in classes.largest}
    if rest := classes.results - sum(by_class.values()):
        by_class[OTHER_CLASSES] = rest
    yield _metric(
        "host_classes", "Host classes of the accepted results; with one, all results are bit-identical.", classes.total
    )
    yield _metric("class_results", "Accepted results of the largest host classes.", by_class, "class")
    checks = status.checks or CheckCounts(0.0)
    outcomes = {"equal": checks.checked - checks.differing, "differs": checks.differing, "unchecked": checks.unchecked}
    yield _metric("drawn_results_total", "Results drawn to be scored again on another host.", outcomes, "outcome")
    yield _metric("recalled_results_total", "Results of barred hosts that count no more.", checks.recalled)
    why = "Hosts that are barred: their results differ, or the operator says so."
    yield _metric("barred_hosts", why, len(checks.barred))
    yield _metric("failing_jobs", "Open jobs that failed on some worker.", status.failing)


def _waste(status: Status) -> Iterator[Metric]:
    waste = status.waste
    yield _metric(
        "discarded_steps_total", "Environment steps of results that were not accepted.", waste.discarded_steps
    )
    jobs = {"reissued": waste.reissued, "recalled": waste.recalled, "copied": waste.copied}
    results = {"duplicate": waste.duplicate, "obsolete": waste.obsolete, "error": waste.errors}
    yield _metric("jobs_given_again_total", "Jobs assigned to another worker in addition or instead.", jobs, "why")
    yield _metric("results_not_counted_total", "Results that were not accepted.", results, "why")
    yield _metric("resent_batches_total", "Batches that were sent again.", waste.resent_batches)
    yield _metric("silences_total", "Workers that fell silent.", waste.silences)
    dropped = dict(list(status.dropped.items())[:MAX_REASONS])
    yield _metric("dropped_messages_total", "Messages that were dropped, by reason.", dropped, "why")


def _workers(workers: Sequence[WorkerStatus]) -> Iterator[Metric]:
    def each(name: str, text: str, value: Callable[[WorkerStatus], float | None]) -> Metric:
        return _metric(f"worker_{name}", text, {one.worker: value(one) for one in workers}, "worker")

    yield each("present", "1 unless it is silent or lost.", lambda one: one.state == "present")
    yield each("slots", "Its slots.", lambda one: one.slots)
    yield each("leases", "Jobs assigned to it.", lambda one: one.leases)
    yield each("finished_total", "Its results that were accepted.", lambda one: one.finished)
    yield each("steps_per_second", "Environment steps a second.", lambda one: one.steps_per_second)
    yield each("job_seconds", "Seconds of a candidate's job in a slot.", lambda one: one.job_seconds)
    yield each("round_trip_seconds", "Upper bound of its network round trip.", lambda one: one.round_trip)
    yield each("resent_batches_total", "Batches sent to it again.", lambda one: one.resent)
    yield each("load", "Its host's load over a minute.", lambda one: one.load)
    yield each("heard_seconds", "Seconds since its last message.", lambda one: one.heard)


def _score(name: str, text: str, found: StoredEvaluation | StoredConfirmation | None) -> Iterator[Metric]:
    yield _metric(name, text, None if found is None else found.mean)
    yield _metric(f"{name}_error", f"Standard error of {name}.", None if found is None else found.error)


def _metric(name: str, text: str, value: float | Mapping[str, float | None] | None, label: str = "") -> Metric:
    """A counter if its name ends so, else a gauge: with one value, or with one for each text of the label.

    `None` is left out.
    """
    kind: type[CounterMetricFamily | GaugeMetricFamily] = (
        CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
    )
    metric = kind(f"dreamfleet_{name}", text, labels=[label] if label else [])
    for key, each in (value if isinstance(value, Mapping) else {"": value}).items():
        if each is not None:
            metric.add_metric([truncate(key, MAX_LABEL_CHARS)], each)
    return metric
