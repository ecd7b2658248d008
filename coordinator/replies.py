"""What a coordinator answers to hellos and control verbs, as documents of the frozen schema.

No answer may be longer than the schema allows, whatever the question was: it could not be encoded.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict

from dreamfleet.common import keys
from dreamfleet.common.fields import written
from dreamfleet.common.fingerprint import package_version
from dreamfleet.common.messages import MAX_TEXT, ControlReply, HelloReply, HelloRequest, Intervals
from dreamfleet.common.printable import shortened
from dreamfleet.coordinator.run import Run

LONGEST_VERB = 60  # characters of a verb that nobody knows
LEAVING = ("drain", "stop", "disband")


def hello_reply(
    run: Run, name: str, nonce: str, intervals: Intervals, why: str = "", remedy: str = "", numbering: int = 0
) -> HelloReply:
    """Welcome to a worker, whose batches have this `numbering`; with `why`, a refusal."""
    return HelloReply(
        accepted=not why,
        protocol_min=keys.PROTOCOL_VERSION,
        protocol_max=keys.PROTOCOL_VERSION,
        package=package_version("dreamfleet") or "unknown",
        run=name,
        run_uid=run.uid,
        incarnation=run.incarnation,
        nonce=nonce,
        why=shortened(why, MAX_TEXT),
        remedy=shortened(remedy, MAX_TEXT),
        spec={} if why else written(run.settings.task),
        intervals={} if why else asdict(intervals),
        packages=run.settings.packages,
        numbering=numbering,
        classes=True,
    )


def misunderstanding(request: HelloRequest | None) -> tuple[str, str] | None:
    """Why a hello cannot be talked about at all, and what to do about it; `None` if it can."""
    if request is None or not keys.is_worker(request.worker):
        return "the request is not a hello", "update dreamfleet on the worker's host"
    return None


def control_verb(asked_at: str) -> str:
    """What a control query's key expression asks for."""
    return asked_at.rsplit("/", 1)[-1]


def control_reply(run: str, asked_at: str, known: Iterable[str], again: str = "") -> ControlReply:
    """Whether a control verb was obeyed: every known one is, if it was asked for at this run's own key.

    After one by which the run is left, `again` continues it.
    """
    known, verb = list(known), control_verb(asked_at)
    if asked_at != keys.control(run, verb):
        why = f"one run is steered at a time, by its own key: ask {keys.control(run, 'VERB')}"
        return ControlReply(v=keys.PROTOCOL_VERSION, run=run, accepted=False, why=why)
    asked = shortened(verb, LONGEST_VERB)
    why = "" if verb in known else f"{asked!r} is no control verb of this version; it knows: {', '.join(known)}"
    told = again if verb in LEAVING and len(again) <= MAX_TEXT and again.isprintable() else ""
    return ControlReply(v=keys.PROTOCOL_VERSION, run=run, accepted=not why, why=why, again=told)
