"""The JSON document that the page shows of a live run, apart from its curves. Pure. `page/live.js` shows it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dreamfleet.common.client.eta import Eta
from dreamfleet.common.client.run_view import LiveRunView, format_episodes
from dreamfleet.common.client.status import ArchiveStatus, Population, Status, WorkerStatus
from dreamfleet.common.printable import format_duration, format_number, printable
from dreamfleet.common.protocol.function_values import fitness_word, is_minimised, value_of
from dreamfleet.common.runs.effort import format_steps
from dreamfleet.common.runs.records import format_mean
from dreamfleet.common.runs.run_paths import resume_command
from dreamfleet.coordinator.addons.dashboard.curves import rounded

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
    word: str = "seed"  # what a scored seed of its evaluations is called


def page_state(look: RunSnapshot) -> dict[str, Any]:
    """The document. Texts from other hosts are made printable; the page must insert them as text, not HTML."""
    status = look.status
    view = LiveRunView.of_status(status, look.word)
    link = OVER if status.is_over else LIVE if look.lost is None else LOST
    states = {LIVE: status.state, LOST: "coordinator lost", OVER: "ended" if status.state == "ended" else "left open"}
    stage = [] if view.stage is None else [f"stage {view.stage.number} of {len(view.settings.stages)}"]
    return {
        "run": status.run, "uid": status.run_uid, "link": link, "stored": look.folder is not None,
        "state": states[link], "sentence": _lost_sentence(look) if link == LOST else _sentence(view),
        "lost": look.lost if link == LOST else None, "heard": look.heard,
        "eta": _eta(view.eta) if link == LIVE else None,
        "task": printable(", ".join([view.about, view.population, *stage])), "word": look.word,
        "tiles": _tiles(view, link), "candidates": _candidates(look.population, status),
        "evaluation": _progress(status, look.word), "search": _search(view), "redundant": _redundant_work(view),
        "troubles": _problems(status), "fleet": _fleet(status, link), "workers": _workers(look, link),
    }  # fmt: skip


def _sentence(view: LiveRunView) -> str:
    """What the run does or waits for, without its state; empty while the open generation's card says it."""
    if view.status.state == "running":
        return ""
    text = printable(view.detail or view.status.state)
    return text[:1].upper() + text[1:]


def _lost_sentence(look: RunSnapshot) -> str:
    command, rest = f"dreamfleet coordinator --resume {look.status.run} --runs-dir FOLDER", "--join where it had one"
    if look.folder is not None:
        command = resume_command(look.folder)
    return (
        "Its coordinator was killed, or the network is cut. The page goes on once it answers again. "
        f"After a kill, continue it: {printable(command)}, with {rest}"
    )


def _eta(eta: Eta) -> dict[str, Any]:
    """The one estimate, without the pace, which a tile has, and the one bar; none of a run whose end is not known."""
    text = replace(eta, pace=None).description
    return {"text": text, "bounds": [] if eta.share is None else [{"text": text, "share": round(eta.share, 4)}]}


def _tiles(view: LiveRunView, link: str) -> list[dict[str, str]]:
    status, last, reported, eta = view.status, view.last, view.reported, view.eta
    spent = format_steps(status.throughput.environment_steps)
    return [
        tile("score", NONE if reported is None else format_mean(reported),
              _awaited_score(status) if reported is None else view.caption(reported)),
        tile("last generation", NONE if last is None else format_number(last.mean),
              f"average of the candidates; {view.spread}" if last else "once a generation closes"),
        *([] if status.archive is None else [_archive_tile(status.archive)]),
        tile("time per generation", NONE if eta.pace is None else format_duration(eta.pace), view.worked),
        tile("throughput", view.speed if link == LIVE else NONE, f"{spent} {view.unit} in all"),
        tile("fleet", view.workers, view.slots) if link == LIVE
        else tile("fleet", NONE, f"{view.workers}, {view.slots} at the last"),
    ]  # fmt: skip


def _archive_tile(archive: ArchiveStatus) -> dict[str, str]:
    if archive.best is None:
        return tile("archive", f"0 of {archive.cells:,}", "cells filled; once a generation closes")
    best = f"the best elite {format_number(archive.best)} in cell {','.join(map(str, archive.best_cell))}"
    caption = f"cells filled; QD score {format_number(archive.qd_score)}; {best}"
    return tile("archive", f"{archive.filled:,} of {archive.cells:,}", caption)


def tile(name: str, value: str, caption: str) -> dict[str, str]:
    """One headline figure for the page."""
    return {"name": name, "value": value, "beneath": caption}


def _awaited_score(status: Status) -> str:
    every = status.settings.evaluate_every
    if not every:
        return "means are not evaluated"
    return f"first evaluation after generation {every - 1}" if every > 1 else "after the first generation"


def _candidates(parts: Sequence[Population], status: Status) -> dict[str, Any]:
    """Columns with a row a candidate: episodes done and wanted, fitness so far; empty without an open generation."""
    if status.state == "ended" or (status.state == "evaluating" and not status.generation.episodes_done):
        parts = ()
    task = status.settings.task
    return {
        "generation": status.generation.number,
        "total": max((each.total for each in parts), default=0),
        "done": [done for each in parts for done in each.done],
        "wanted": [wanted for each in parts for wanted in each.wanted],
        "fitness": [rounded(value and value_of(value, task)) for each in parts for value in each.fitness],
        "word": fitness_word(task),
        "minimised": is_minimised(task),
    }


def _progress(status: Status, word: str) -> list[str]:
    """The evaluation, the confirmation and the kept rollouts in progress."""
    parts = {
        "evaluation of the mean": (status.evaluating, word), "confirmation": (status.confirming, word),
        "kept rollouts": (status.collecting, "episode"),
    }  # fmt: skip
    return [
        f"{name}: {format_episodes(each, noun)}"
        for name, (each, noun) in parts.items()
        if each.episodes > each.episodes_done
    ]


def _search(view: LiveRunView) -> Facts:
    open_one = view.status.generation
    facts = [("optimiser", printable(view.optimiser))]
    if not view.settings.is_external:
        facts.insert(0, ("step size", f"{open_one.sigma:.4g}"))
    if open_one.axis_ratio is not None:
        facts.append(("axis ratio", f"{open_one.axis_ratio:,.4g} (longest axis of the search over the shortest)"))
    if open_one.temperature is not None:
        facts.append(("temperature", f"{open_one.temperature:g}"))
    if view.failed:
        facts.append(("failed candidates", f"{view.failed:,}, {open_one.failed} of this generation"))
    return facts


def _redundant_work(view: LiveRunView) -> dict[str, Any]:
    """Work that was repeated or discarded: a line, and what is not zero."""
    status, waste = view.status, view.status.waste
    counts = [
        (f"discarded {view.unit}", waste.discarded_steps), ("jobs issued again", waste.reissued),
        ("jobs recalled", waste.recalled), ("jobs copied at a generation's end", waste.copied),
        ("duplicate results", waste.duplicate), ("obsolete results", waste.obsolete), ("errors", waste.errors),
        ("batches sent again", waste.resent_batches), ("silences of workers", waste.silences),
        *((f"messages dropped: {printable(why)}", count) for why, count in status.dropped.items()),
    ]  # fmt: skip
    rows = [(name, f"{count:,}") for name, count in counts if count]
    return {"text": view.wasted if rows else "none", "rows": rows}


def _problems(status: Status) -> list[str]:
    found = [*filter(None, [status.equal_fitness]), *status.refusals]
    for failure in status.failures:
        for worker, error in failure.errors.items():
            times = failure.attempts.get(worker, 1)
            found.append(f"{failure.subject}, failed on {worker} ({times}x): {error}")
    return [printable(each) for each in found]


def _fleet(status: Status, link: str) -> str:
    """What no tile says of the fleet: who is missing, and the classes of hosts."""
    counts = status.workers
    silent = counts.known - counts.present - counts.lost - counts.left
    parts = [f"{count} {state}" for count, state in ((silent, "silent"), (counts.lost, "lost"), (counts.left, "left"))
             if count > 0]  # fmt: skip
    missing = f"{'' if link == LIVE else 'at the last: '}{', '.join(parts)}" if parts else ""
    classes = status.classes.description if status.classes.total else ""
    checks = "" if status.checks is None else f"checks: {status.checks.description}"
    return "; ".join(filter(None, (missing, classes, checks)))


def _workers(look: RunSnapshot, link: str) -> dict[str, list[Any]]:
    """Columns with a row a worker, sorted by host. Momentary values are empty unless the run is live."""
    with_lanes = sorted(zip(look.workers, look.lanes, strict=True), key=lambda row: row[0].worker)
    rows = [worker for worker, _ in with_lanes]
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
        "lane": [lane for _, lane in with_lanes],
    }
