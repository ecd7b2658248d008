"""What a coordinator answers to hellos and control verbs, as documents of the frozen schema.

No answer may be longer than the schema allows, whatever the question was: it could not be encoded.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict

from dreamfleet.common.host.packages import package_version
from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.messages import ControlReply, HelloReply, HelloRequest, Intervals
from dreamfleet.common.serialization.optional_fields import to_dict
from dreamfleet.common.serialization.validation import MAX_TEXT
from dreamfleet.coordinator.run.run import Run

LONGEST_VERB = 60  # characters of a verb that nobody knows
LEAVING_VERBS = ("drain", "stop", "disband")


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
        why=truncate(why, MAX_TEXT),
        remedy=truncate(remedy, MAX_TEXT),
        spec={} if why else to_dict(run.settings.task),
        intervals={} if why else asdict(intervals),
        packages=run.settings.packages,
        numbering=numbering,
        classes=True,
    )


def malformed_hello(request: HelloRequest | None) -> tuple[str, str] | None:
    """Why a hello cannot be talked about at all, and what to do about it; `None` if it can."""
    if request is None or not keys.is_worker_identity(request.worker):
        return "the request is not a hello", "update dreamfleet on the worker's host"
    return None


def control_verb(query_key: str) -> str:
    """What a control query's key expression asks for."""
    return query_key.rsplit("/", 1)[-1]


def control_reply(run: str, query_key: str, known: Iterable[str], resume_command: str = "") -> ControlReply:
    """Whether a control verb was obeyed: every known one is, if it was asked for at this run's own key.

    After one by which the run is left, `again` continues it.
    """
    known, verb = list(known), control_verb(query_key)
    if query_key != keys.control(run, verb):
        why = f"one run is steered at a time, by its own key: ask {keys.control(run, 'VERB')}"
        return ControlReply(v=keys.PROTOCOL_VERSION, run=run, accepted=False, why=why)
    asked = truncate(verb, LONGEST_VERB)
    why = "" if verb in known else f"{asked!r} is no control verb of this version; it knows: {', '.join(known)}"
    command = (
        resume_command
        if verb in LEAVING_VERBS and len(resume_command) <= MAX_TEXT and resume_command.isprintable()
        else ""
    )
    return ControlReply(v=keys.PROTOCOL_VERSION, run=run, accepted=not why, why=why, again=command)
