"""One immutable snapshot of a run, as JSON documents; every view reads it and none touches the run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from dreamfleet.common.fingerprint import package_version
from dreamfleet.coordinator.member import Member
from dreamfleet.coordinator.run import Run

SCHEMA = 1
PARTS = ("", "generation", "workers", "history", "best")
PAGE = 100  # rows of a page at most, so that a reply stays under the message limit


class Parameters(Protocol):
    """A query's parameters."""

    def get(self, key: str) -> str | None:
        """One of them, if it was given."""


@dataclass(frozen=True)
class Snapshot:
    """What `status` and its parts answer."""

    status: dict[str, Any]
    generation: dict[str, Any]
    workers: list[dict[str, Any]]
    history: list[dict[str, Any]]
    best: dict[str, Any]

    def answer(self, part: str, parameters: Parameters) -> bytes:
        """The JSON of one part; `workers` and `history` are paged by `offset` and `limit`."""
        head = {"schema": SCHEMA, "run": self.status["run"], "run_uid": self.status["run_uid"]}
        if part in ("workers", "history"):
            rows = self.workers if part == "workers" else self.history
            offset, limit = _number(parameters.get("offset"), 0), min(_number(parameters.get("limit"), PAGE), PAGE)
            page = {"offset": offset, "total": len(rows), part: rows[offset : offset + limit]}
            return json.dumps({**head, **page}).encode()
        document = {"generation": self.generation, "best": self.best}.get(part, self.status)
        return json.dumps({**head, **document}).encode()


def take_snapshot(run: Run, name: str, dropped: Mapping[str, int], uptime: float, now: float) -> Snapshot:
    """The run as it is at `now`, seconds of the monotonic clock; `uptime` in seconds."""
    members = list(run.fleet.members.values())
    generation = {
        "number": run.generation.number,
        "episodes_done": run.generation.done,
        "episodes": run.generation.total,
        "seconds": round(now - run.opened, 1),
        "sigma": run.sigma,
        "temperature": run.temperature,
    }
    last = asdict(run.history[-1]) if run.history else None
    evaluation = asdict(run.evaluations[-1]) if run.evaluations else None
    best = asdict(run.best) if run.best else None
    done, wanted = run.evaluation_progress
    kept, to_keep = run.collection_progress
    status = {
        "run": name,
        "run_uid": run.uid,
        "incarnation": run.incarnation,
        "package": package_version("dreamfleet"),
        "state": _state(run, members),
        "why": run.paused or run.ended or "",
        "settings": asdict(run.settings),
        "limits": asdict(run.limits),
        "uptime": round(uptime, 1),
        "generation": generation,
        "last": last,
        "evaluation": evaluation,
        "evaluating": {"episodes_done": done, "episodes": wanted},
        "collecting": {"episodes_done": kept, "episodes": to_keep},
        "best": best,
        "workers": {"present": sum(member.present for member in members), "known": len(members)},
        "slots": sum(member.slots for member in members if member.present),
        "fingerprint": run.fingerprint,
        "throughput": {
            "steps_per_second": round(sum(member.steps_per_second for member in members if member.present), 1),
            "environment_steps": run.steps + run.generation.steps,
        },
        "waste": _waste(run),
        "failures": [_failure(work.job.generation, work.job.candidate, errors) for work, errors in run.fleet.failures],
        "dropped": dict(dropped),
    }
    return Snapshot(
        status,
        {**generation, "last": last},
        [_member(member, now) for member in members],
        [asdict(each) for each in run.history],
        {"best": best, "evaluations": len(run.evaluations)},
    )


def _state(run: Run, members: list[Member]) -> str:
    if run.ended is not None:
        return "ended"
    if run.paused is not None:
        return "paused"
    if not any(member.present and member.capacity for member in members):
        return "waiting for workers"
    return "evaluating" if run.fleet.hurry else "running"


def _waste(run: Run) -> dict[str, Any]:
    counts = run.fleet.counts
    discarded, accepted = counts["discarded_steps"], counts["accepted_steps"]
    return {
        "discarded_steps": discarded,
        "share": round(discarded / (discarded + accepted), 4) if discarded else 0.0,
        **{
            name: counts[name]
            for name in (
                "reissued",
                "recalled",
                "copied",
                "duplicate",
                "obsolete",
                "errors",
                "resent_batches",
                "silences",
            )
        },
    }


def _failure(generation: int, candidate: int, errors: Mapping[str, str]) -> dict[str, Any]:
    return {"candidate": f"{generation}/{candidate}", "errors": dict(errors)}


def _member(member: Member, now: float) -> dict[str, Any]:
    return {
        "worker": member.identity,
        "state": "lost" if member.lost is not None else "silent" if member.silent else "present",
        "slots": member.slots,
        "leases": len(member.leases),
        "finished": member.finished,
        "steps_per_second": round(member.steps_per_second, 1),
        "load": round(member.load, 2),
        "drawn_by": member.drawn_by,
        "heard": round(now - member.heard, 1),
        "fingerprint": member.fingerprint,
    }


def _number(text: str | None, default: int) -> int:
    return int(text) if text is not None and text.isdecimal() else default
