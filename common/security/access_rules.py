"""Who may do what on the wire: the rules by role that a secured router holds everybody to, as Zenoh reads them.

Zenoh's rules stand while a router runs, and name certificates one by one. So each role has a fixed number of seats that
are ruled from the start, and a worker's name ends in its own: rules hold it to `*.17`, whoever has the file of seat 17
and whenever that was issued. What is allowed to nobody is denied, silently.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

from dreamfleet.common.protocol import keys
from dreamfleet.common.security.credentials import SEATS, identity

INGRESS, EGRESS = "ingress", "egress"  # as the router sees it: from whom the rule is about, to whom
ALL_MESSAGES = (
    "put", "delete", "query", "reply", "declare_subscriber", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
_ANY_RUN = "*"
_STATUS = (keys.status(_ANY_RUN), keys.status(_ANY_RUN, "*"))
_EVENTS = (keys.event_generation(_ANY_RUN), keys.event_status(_ANY_RUN))
_BUNDLE, _CONTROL = keys.bundle(_ANY_RUN, "*"), keys.control(_ANY_RUN, "*")
_VIEWS = keys.all_workers("view", _ANY_RUN)
_WORKER_MESSAGES = tuple(keys.all_workers(kind, _ANY_RUN) for kind in ("result", "beat", "upload", "view"))
_COORDINATORS = keys.live_coordinator(_ANY_RUN, "*")


def access_control_config(passwords: bool, revoked_seats: Collection[str] = ()) -> dict[str, Any]:
    """Zenoh's `access_control`; the seats in `revoked_seats` may do nothing. With `passwords` subjects are users."""
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
            policies.append({"subjects": [who], "rules": [f"{who} {each}" for each in ("says", "hears", "is", "told")]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


_ROLES = {
    "coordinator": ("trusted",),
    "router": ("trusted",),
    "viewer": ("look", "watch", "shown"),
    "operator": ("look", "watch", "shown", "control", "controlled"),
    "worker": ("work", "worked"),
}


def _rule(name: str, flows: tuple[str, ...], messages: tuple[str, ...], on: tuple[str, ...]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": list(flows), "messages": list(messages),
            "key_exprs": list(on)}  # fmt: skip


def _viewer_rules() -> Iterator[dict[str, Any]]:
    """Of who looks, and of who steers too."""
    yield _rule("look", (INGRESS,), ("query",), _STATUS)
    yield _rule("watch", (INGRESS,), ("declare_subscriber",), (*_EVENTS, _VIEWS))
    yield _rule("shown", (EGRESS,), ("put", "reply", "declare_queryable"), (*_STATUS, *_EVENTS, _VIEWS))
    yield _rule("control", (INGRESS,), ("query",), (_CONTROL, _BUNDLE))
    yield _rule("controlled", (EGRESS,), ("reply", "declare_queryable"), (_CONTROL, _BUNDLE))


def _common_worker_rules() -> Iterator[dict[str, Any]]:
    """What all workers have in common: they ask how runs are, fetch the world model, and see who coordinates."""
    yield _rule("work", (INGRESS,), ("query", "liveliness_query", "declare_liveliness_subscriber"),
                (_STATUS[0], _BUNDLE, _COORDINATORS))  # fmt: skip
    yield _rule("worked", (EGRESS,), ("reply", "declare_queryable", "liveliness_token", "declare_subscriber"),
                (_STATUS[0], _BUNDLE, _COORDINATORS, *_WORKER_MESSAGES))  # fmt: skip


def _seat_rules(who: str, seat: int) -> Iterator[dict[str, Any]]:
    """What one worker may, under names that end in its seat."""
    worker = f"$*.{seat}/*"
    hello, job = keys.secured_hello(_ANY_RUN, worker), keys.job(_ANY_RUN, worker)
    said = tuple(each(_ANY_RUN, worker) for each in (keys.result, keys.beat, keys.upload, keys.view))
    yield _rule(f"{who} says", (INGRESS,), ("put",), said)
    yield _rule(f"{who} hears", (INGRESS,), ("declare_subscriber", "query"), (job, hello))
    yield _rule(f"{who} is", (INGRESS,), ("liveliness_token",), (keys.live_worker(_ANY_RUN, worker),))
    yield _rule(f"{who} told", (EGRESS,), ("put", "reply", "declare_queryable"), (job, hello))
