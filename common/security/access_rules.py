"""The access rules of a secured router, by role, as Zenoh's configuration.

Zenoh's rules are fixed while a router runs, and list certificates one by one. So each role has a fixed number of seats
with rules from the start. A worker's name ends in its seat, and the rules of seat 17 allow it only names `*.17`,
whenever its join file was issued. Everything else is denied, silently.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

from dreamfleet.common.protocol import keys
from dreamfleet.common.security.credentials import SEATS, identity

INGRESS, EGRESS = "ingress", "egress"  # messages to the router from the rule's subject, and from the router to it
ALL_MESSAGES = (
    "put", "delete", "query", "reply", "declare_subscriber", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
_ANY_RUN = "*"
_STATUS = (keys.status(_ANY_RUN), keys.status(_ANY_RUN, "*"))
_EVENTS = (keys.event_generation(_ANY_RUN), keys.event_status(_ANY_RUN))
_BUNDLE, _CONTROL = keys.bundle(_ANY_RUN, "*"), keys.control(_ANY_RUN, "*")
_BATCHES, _BATCH_EVENTS = keys.batch(_ANY_RUN, "*"), keys.event_batch(_ANY_RUN)
_VIEWS = keys.all_workers("view", _ANY_RUN)
_WORKER_MESSAGES = tuple(keys.all_workers(kind, _ANY_RUN) for kind in ("result", "beat", "upload", "view"))
_COORDINATORS = keys.live_coordinator(_ANY_RUN, "*")


def access_control_config(passwords: bool, revoked_seats: Collection[str] = ()) -> dict[str, Any]:
    """Zenoh's `access_control`: by users with `passwords`, else by certificates; `revoked_seats` may do nothing."""
    rules = [
        _rule("trusted", (INGRESS, EGRESS), ALL_MESSAGES, (f"{keys.ROOT}/**",)),
        *_viewer_rules(),
        *_common_worker_rules(),
    ]
    of = "usernames" if passwords else "cert_common_names"
    subjects, policies = [], []
    for role, own in _ROLES.items():
        seats = [each for number in range(1, SEATS[role] + 1) if (each := identity(role, number)) not in revoked_seats]
        subjects.append({"id": role, of: seats})
        policies.append({"subjects": [role], "rules": list(own)})
    for number in range(1, SEATS["worker"] + 1):
        if (who := identity("worker", number)) not in revoked_seats:
            rules.extend(_seat_rules(who, number))
            subjects.append({"id": who, of: [who]})
            policies.append({"subjects": [who], "rules": [f"{who} {each}" for each in _SEAT_RULES]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


_ROLES = {
    "coordinator": ("trusted",),
    "router": ("trusted",),
    "viewer": ("look", "watch", "see"),
    "operator": ("look", "watch", "see", "control", "control replies", "watch batches", "see batches"),
    "worker": ("work", "work replies"),
}
_SEAT_RULES = ("sends", "receives", "is live", "gets")


def _rule(name: str, flows: tuple[str, ...], messages: tuple[str, ...], on: tuple[str, ...]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": list(flows), "messages": list(messages),
            "key_exprs": list(on)}  # fmt: skip


def _viewer_rules() -> Iterator[dict[str, Any]]:
    """The rules of viewers and operators."""
    yield _rule("look", (INGRESS,), ("query",), _STATUS)
    yield _rule("watch", (INGRESS,), ("declare_subscriber",), (*_EVENTS, _VIEWS))
    yield _rule("see", (EGRESS,), ("put", "reply", "declare_queryable"), (*_STATUS, *_EVENTS, _VIEWS))
    yield _rule("control", (INGRESS,), ("query",), (_CONTROL, _BUNDLE, _BATCHES))
    yield _rule("control replies", (EGRESS,), ("reply", "declare_queryable"), (_CONTROL, _BUNDLE, _BATCHES))
    yield _rule("watch batches", (INGRESS,), ("declare_subscriber",), (_BATCH_EVENTS,))
    yield _rule("see batches", (EGRESS,), ("put",), (_BATCH_EVENTS,))


def _common_worker_rules() -> Iterator[dict[str, Any]]:
    """The rules of all workers: query statuses, fetch the world model, and see live coordinators."""
    yield _rule("work", (INGRESS,), ("query", "liveliness_query", "declare_liveliness_subscriber"),
                (_STATUS[0], _BUNDLE, _COORDINATORS))  # fmt: skip
    yield _rule("work replies", (EGRESS,), ("reply", "declare_queryable", "liveliness_token", "declare_subscriber"),
                (_STATUS[0], _BUNDLE, _COORDINATORS, *_WORKER_MESSAGES))  # fmt: skip


def _seat_rules(who: str, seat: int) -> Iterator[dict[str, Any]]:
    """The rules of one worker's seat, for names that end in it."""
    worker = f"$*.{seat}/*"
    hello, job = keys.secured_hello(_ANY_RUN, worker), keys.job(_ANY_RUN, worker)
    sent = tuple(each(_ANY_RUN, worker) for each in (keys.result, keys.heartbeat, keys.upload, keys.view))
    yield _rule(f"{who} sends", (INGRESS,), ("put",), sent)
    yield _rule(f"{who} receives", (INGRESS,), ("declare_subscriber", "query"), (job, hello))
    yield _rule(f"{who} is live", (INGRESS,), ("liveliness_token",), (keys.live_worker(_ANY_RUN, worker),))
    yield _rule(f"{who} gets", (EGRESS,), ("put", "reply", "declare_queryable"), (job, hello))
