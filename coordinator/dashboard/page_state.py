"""The JSON document that the page shows of a live run, apart from its curves. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dreamfleet.common.monitoring.eta import Eta, describe_state, estimate_eta, format_duration
from dreamfleet.common.monitoring.status import Population, Status, WorkerStatus
from dreamfleet.common.printable import plural, printable
from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.common.runs.effort import format_steps
from dreamfleet.common.runs.records import (
    RunSettings,
    StoredConfirmation,
    StoredEvaluation,
    StoredGeneration,
    count_episodes,
)
from dreamfleet.common.runs.run_paths import resume_command
from dreamfleet.common.runs.stages import describe_steps
from dreamfleet.common.runs.standard_error import format_with_error

LIVE, LOST, OVER = "live", "lost", "over"
NONE = "-"
Facts = list[tuple[str, str]]


@dataclass(frozen=True)
class RunSnapshot:
    """A run's last known state."""

    status: Status
    workers: Sequence[WorkerStatus]
    lanes: Sequence[str]  # of `Lanes.render`, one a worker
    population: Sequence[Population]  # the open generation's candidates, in parts
    heard: float  # seconds since 1970
    lost: float | None = None  # seconds since 1970 at which answers stopped
    folder: Path | None = None  # of its journal, if on this disk


def page_state(look: RunSnapshot) -> dict[str, Any]:
    """The document. Texts from other hosts are made printable; the page must insert them as text, not HTML."""
    status = look.status
    link = OVER if status.is_over else LIVE if look.lost is None else LOST
    eta = estimate_eta(status)
    return {
        "run": status.run,
        "uid": status.run_uid,
        "link": link,
        "stored": look.folder is not None,
        "state": {LOST: "coordinator lost", LIVE: status.state}.get(link, _ended_state(status)),
        "sentence": _lost_sentence(look) if link == LOST else printable(describe_state(status)),
        "lost": look.lost if link == LOST else None,
        "heard": look.heard,
        "eta": _eta(eta) if link == LIVE else None,
        "task": printable(_task(status)),
        "tiles": _tiles(status, eta, link),
        "candidates": _candidates(look.population, status),
        "evaluation": _progress(status),
        "search": _search(status),
        "waste": _waste(status),
        "troubles": _problems(status),
        "fleet": _fleet(status, link),
        "workers": _workers(look, link),
    }


def _ended_state(status: Status) -> str:
    return "ended" if status.state == "ended" else "left open"


def _lost_sentence(look: RunSnapshot) -> str:
    rest = "--join where it had one" if look.folder else "--runs-dir and --join where it had them"
    words = (
        ("dreamfleet coordinator --resume", look.status.run) if look.folder is None else (resume_command(look.folder),)
    )
    return (
        "nobody answers for it: its coordinator was killed, or the network is cut. The page goes on once it is back. "
        f"After a kill, continue it: {printable(' '.join(words))}, with {rest}"
    )


def _eta(eta: Eta) -> dict[str, Any]:
    bounds = [{"text": each.description, "share": round(each.share, 4)} for each in eta.bounds]
    return {"text": eta.description, "bounds": bounds}


def _task(status: Status) -> str:
    settings, stage = status.settings, status.generation.stage
    size = settings if stage is None else stage
    horizon = settings.task.horizon if stage is None else stage.horizon
    steps = describe_steps(horizon, size.driven, dreamt=settings.task.task == DREAM)
    candidates = f"{size.population} candidates x {plural(size.episodes, 'episode')}"
    parts = [settings.task.task, candidates, steps]
    if stage is not None:
        parts.append(f"stage {stage.number} of {stage.total}")
    return ", ".join(parts)


def _tiles(status: Status, eta: Eta, link: str) -> list[dict[str, str]]:
    """The headline figures: name, value and caption."""
    reported = status.confirmed or status.best
    spent = status.throughput
    pace = "" if eta.pace is None else f"{format_duration(eta.pace)} each"
    last = status.last
    workers, slots = plural(status.workers.present, "worker"), plural(status.slots, "slot")
    return [
        _tile("generation", f"{status.generation.number:,}", pace),
        _tile("last generation", NONE if last is None else f"{last.mean:,.1f}", _last_generation_caption(last)),
        _tile("reported", NONE if reported is None else format_score(reported), _reported_caption(reported)),
        _tile("throughput", f"{format_steps(round(spent.steps_per_second))} steps/s" if link == LIVE else NONE,
              f"{format_steps(spent.environment_steps)} steps in all"),
        _tile("fleet", workers, slots) if link == LIVE else _tile("fleet", NONE, f"{workers}, {slots} at the last"),
    ]  # fmt: skip


def _tile(name: str, value: str, caption: str) -> dict[str, str]:
    return {"name": name, "value": value, "beneath": caption}


def format_score(found: StoredEvaluation | StoredConfirmation) -> str:
    """Format a mean with its standard error, if it has one."""
    return format_with_error(found.mean, found.error, sign=",")


def _last_generation_caption(last: StoredGeneration | None) -> str:
    return "none is closed yet" if last is None else f"mean; {last.worst:,.1f} to {last.best:,.1f}"


def _reported_caption(reported: StoredEvaluation | StoredConfirmation | None) -> str:
    if reported is None:
        return "no evaluation yet"
    kind = "confirmed" if isinstance(reported, StoredConfirmation) else "provisional"
    return f"{kind}, generation {reported.generation}, {count_episodes(reported)}"


def _candidates(parts: Sequence[Population], status: Status) -> dict[str, Any]:
    """Columns with a row a candidate: episodes done and wanted, fitness so far; empty without an open generation."""
    if status.state == "ended" or (status.state == "evaluating" and not status.generation.episodes_done):
        parts = ()
    return {
        "generation": status.generation.number,
        "total": max((each.total for each in parts), default=0),
        "done": [done for each in parts for done in each.done],
        "wanted": [wanted for each in parts for wanted in each.wanted],
        "fitness": [None if value is None else float(f"{value:.5g}") for each in parts for value in each.fitness],
    }


def _progress(status: Status) -> list[dict[str, Any]]:
    """Progress of evaluation, confirmation and kept rollouts."""
    parts = {
        "evaluation of the mean": status.evaluating, "confirmation": status.confirming,
        "kept rollouts": status.collecting,
    }  # fmt: skip
    return [
        {"name": name, "done": each.episodes_done, "wanted": each.episodes}
        for name, each in parts.items()
        if each.episodes > each.episodes_done
    ]


def _search(status: Status) -> Facts:
    open_one, settings = status.generation, status.settings
    facts = [("step size", f"{open_one.sigma:.4g}"), ("optimiser", describe_optimiser(settings))]
    if open_one.axis_ratio is not None:
        facts.append(("axis ratio", f"{open_one.axis_ratio:,.4g}"))
    if open_one.temperature is not None:
        facts.append(("temperature", f"{open_one.temperature:g}"))
    if status.throughput.seconds is not None and status.elapsed is not None:
        worked = status.throughput.seconds + open_one.seconds
        facts.append(("time", f"{format_duration(worked)} of work in {format_duration(status.elapsed)}"))
    if failed := status.failed + open_one.failed:
        facts.append(("failed candidates", f"{failed:,}, {open_one.failed} of this generation"))
    if status.last is not None:
        facts.append(("spread of the last generation", f"{status.last.std:,.1f} (standard deviation)"))
    return facts


def describe_optimiser(settings: RunSettings) -> str:
    """The optimiser's name, with the kind of covariance matrix for CMA-ES."""
    return printable(f"CMA-ES, {settings.covariance}" if settings.optimiser == "cma" else settings.optimiser)


def _waste(status: Status) -> Facts:
    """Work that was repeated or discarded."""
    waste = status.waste
    return [
        ("share of steps", f"{waste.share:.1%}"), ("discarded steps", f"{waste.discarded_steps:,}"),
        ("jobs issued again", f"{waste.reissued:,}"), ("recalled", f"{waste.recalled:,}"),
        ("copied at a generation's end", f"{waste.copied:,}"), ("duplicate results", f"{waste.duplicate:,}"),
        ("obsolete results", f"{waste.obsolete:,}"), ("errors", f"{waste.errors:,}"),
        ("batches sent again", f"{waste.resent_batches:,}"), ("silences", f"{waste.silences:,}"),
        *((f"dropped: {printable(why)}", f"{count:,}") for why, count in status.dropped.items() if count),
    ]  # fmt: skip


def _problems(status: Status) -> list[str]:
    """Problems that may need action."""
    found = status.refusals
    for failure in status.failures:
        for worker, error in failure.errors.items():
            times = failure.attempts.get(worker, 1)
            found.append(f"{failure.subject}, failed on {worker} ({times}x): {error}")
    return [printable(each) for each in found]


def _fleet(status: Status, link: str) -> str:
    counts = status.workers
    lost = counts.lost or 0
    silent = counts.known - counts.present - lost - counts.left
    text = f"{counts.present} present, {plural(status.slots, 'slot')}"
    text += "".join(f", {count} {state}" for count, state in ((silent, "silent"), (lost, "lost"), (counts.left, "left"))
                    if count > 0)  # fmt: skip
    text = text if link == LIVE else f"at the last: {text}"
    return f"{text}; {status.classes.description}" if status.classes.total else text


def _workers(look: RunSnapshot, link: str) -> dict[str, list[Any]]:
    """Columns with a row a worker, sorted by host. Momentary values are empty unless the run is live."""
    order = sorted(range(len(look.workers)), key=lambda index: look.workers[index].worker)
    rows = [look.workers[index] for index in order]
    return {
        "worker": [printable(each.worker) for each in rows],
        "state": [printable(each.state) if link == LIVE else NONE for each in rows],
        "reason": [printable(each.reason) for each in rows],
        "slots": [each.slots for each in rows],
        "leases": [each.leases if link == LIVE else None for each in rows],
        "finished": [each.finished for each in rows],
        "rate": [round(each.steps_per_second) if link == LIVE else None for each in rows],
        "load": [each.load if link == LIVE else None for each in rows],
        "heard": [round(each.heard, 1) if link == LIVE else None for each in rows],
        "picture": [printable(each.drawn_by) for each in rows],
        "lane": [look.lanes[index] for index in order],
    }
