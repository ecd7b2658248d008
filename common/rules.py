"""Who may do what on the wire: the rules by role that a secured router holds everybody to, as Zenoh reads them.

Zenoh's rules stand while a router runs, and name certificates one by one. So each role has a fixed number of seats that
are ruled from the start, and a worker's name ends in its own: rules hold it to `*.17`, whoever has the file of seat 17
and whenever that was issued. What is allowed to nobody is denied, silently.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

from dreamfleet.common import keys
from dreamfleet.common.credentials import SEATS, identity

IN, OUT = "ingress", "egress"  # as the router sees it: from whom the rule is about, to whom
EVERYTHING = (
    "put", "delete", "query", "reply", "declare_subscriber", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
_ANY_RUN = "*"
_STATUS = (keys.status(_ANY_RUN), keys.status(_ANY_RUN, "*"))
_EVENTS = (keys.event_generation(_ANY_RUN), keys.event_status(_ANY_RUN))
_BUNDLE, _CONTROL = keys.bundle(_ANY_RUN, "*"), keys.control(_ANY_RUN, "*")
_VIEWS = keys.any_worker("view", _ANY_RUN)
_HEARD = tuple(keys.any_worker(kind, _ANY_RUN) for kind in ("result", "beat", "upload", "view"))
_COORDINATORS = keys.live_coordinator(_ANY_RUN, "*")


def access_control(passwords: bool, barred: Collection[str] = ()) -> dict[str, Any]:
    """Zenoh's `access_control`; the seats in `barred` may do nothing. With `passwords` subjects are users."""
    rules = [_rule("trusted", (IN, OUT), EVERYTHING, (f"{keys.ROOT}/**",)), *_lookers(), *_workers()]
    of = "usernames" if passwords else "cert_common_names"
    subjects, policies = [], []
    for role, own in _ROLES.items():
        seats = [each for number in range(1, SEATS[role] + 1) if (each := identity(role, number)) not in barred]
        subjects.append({"id": role, of: seats})
        policies.append({"subjects": [role], "rules": list(own)})
    for number in range(1, SEATS["worker"] + 1):
        if (who := identity("worker", number)) not in barred:
            rules.extend(_own(who, number))
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


def _lookers() -> Iterator[dict[str, Any]]:
    """Of who looks, and of who steers too."""
    yield _rule("look", (IN,), ("query",), _STATUS)
    yield _rule("watch", (IN,), ("declare_subscriber",), (*_EVENTS, _VIEWS))
    yield _rule("shown", (OUT,), ("put", "reply", "declare_queryable"), (*_STATUS, *_EVENTS, _VIEWS))
    yield _rule("control", (IN,), ("query",), (_CONTROL, _BUNDLE))
    yield _rule("controlled", (OUT,), ("reply", "declare_queryable"), (_CONTROL, _BUNDLE))


def _workers() -> Iterator[dict[str, Any]]:
    """What all workers have in common: they ask how runs are, fetch the world model, and see who coordinates."""
    yield _rule("work", (IN,), ("query", "liveliness_query", "declare_liveliness_subscriber"),
                (_STATUS[0], _BUNDLE, _COORDINATORS))  # fmt: skip
    yield _rule("worked", (OUT,), ("reply", "declare_queryable", "liveliness_token", "declare_subscriber"),
                (_STATUS[0], _BUNDLE, _COORDINATORS, *_HEARD))  # fmt: skip


def _own(who: str, seat: int) -> Iterator[dict[str, Any]]:
    """What one worker may, under names that end in its seat."""
    worker = f"$*.{seat}/*"
    hello, job = keys.hello_of(_ANY_RUN, worker), keys.job(_ANY_RUN, worker)
    said = tuple(each(_ANY_RUN, worker) for each in (keys.result, keys.beat, keys.upload, keys.view))
    yield _rule(f"{who} says", (IN,), ("put",), said)
    yield _rule(f"{who} hears", (IN,), ("declare_subscriber", "query"), (job, hello))
    yield _rule(f"{who} is", (IN,), ("liveliness_token",), (keys.live_worker(_ANY_RUN, worker),))
    yield _rule(f"{who} told", (OUT,), ("put", "reply", "declare_queryable"), (job, hello))
