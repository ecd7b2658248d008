"""The access rules of a secured router, by role, as Zenoh's configuration.

Zenoh's rules are fixed while a router runs, and list certificates one by one. So each role has a fixed number of seats
with rules from the start. A worker's name ends in its seat, and the rules of seat 17 allow it only names `*.17`,
whenever its join file was issued. Everything else is denied, silently.
"""

from collections.abc import Collection
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


_RULES = (
    ("trusted", (INGRESS, EGRESS), ALL_MESSAGES, (f"{keys.ROOT}/**",)),
    # Viewers and operators
    ("look", (INGRESS,), ("query",), _STATUS),
    ("watch", (INGRESS,), ("declare_subscriber",), (*_EVENTS, _VIEWS)),
    ("see", (EGRESS,), ("put", "reply", "declare_queryable"), (*_STATUS, *_EVENTS, _VIEWS)),
    ("control", (INGRESS,), ("query",), (_CONTROL, _BUNDLE, _BATCHES)),
    ("control replies", (EGRESS,), ("reply", "declare_queryable"), (_CONTROL, _BUNDLE, _BATCHES)),
    ("watch batches", (INGRESS,), ("declare_subscriber",), (_BATCH_EVENTS,)),
    ("see batches", (EGRESS,), ("put",), (_BATCH_EVENTS,)),
    # Workers query statuses, fetch the world model, and see live coordinators
    ("work", (INGRESS,), ("query", "liveliness_query", "declare_liveliness_subscriber"),
     (_STATUS[0], _BUNDLE, _COORDINATORS)),
    ("work replies", (EGRESS,), ("reply", "declare_queryable", "liveliness_token", "declare_subscriber"),
     (_STATUS[0], _BUNDLE, _COORDINATORS, *_WORKER_MESSAGES)),
)  # fmt: skip
_RULES_OF_ROLES = {
    "coordinator": ("trusted",),
    "router": ("trusted",),
    "viewer": ("look", "watch", "see"),
    "operator": ("look", "watch", "see", "control", "control replies", "watch batches", "see batches"),
    "worker": ("work", "work replies"),
}


def access_control_config(passwords: bool, revoked_seats: Collection[str] = ()) -> dict[str, Any]:
    """Zenoh's `access_control`: by users with `passwords`, else by certificates; `revoked_seats` may do nothing."""
    rules, subjects, policies = [_rule(*each) for each in _RULES], [], []
    of = "usernames" if passwords else "cert_common_names"
    for role, own in _RULES_OF_ROLES.items():
        seats = [each for number in range(1, SEATS[role] + 1) if (each := identity(role, number)) not in revoked_seats]
        subjects.append({"id": role, of: seats})
        policies.append({"subjects": [role], "rules": list(own)})
    for number in range(1, SEATS["worker"] + 1):
        if (who := identity("worker", number)) not in revoked_seats:
            of_seat = _seat_rules(who, number)
            rules += of_seat
            subjects.append({"id": who, of: [who]})
            policies.append({"subjects": [who], "rules": [each["id"] for each in of_seat]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


def _rule(name: str, flows: tuple[str, ...], messages: tuple[str, ...], on: tuple[str, ...]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": list(flows), "messages": list(messages), "key_exprs": list(on)}


def _seat_rules(who: str, seat: int) -> list[dict[str, Any]]:
    """The rules of one worker's seat, for names that end in it."""
    worker = f"$*.{seat}/*"
    hello, job = keys.secured_hello(_ANY_RUN, worker), keys.job(_ANY_RUN, worker)
    sent = tuple(each(_ANY_RUN, worker) for each in (keys.result, keys.heartbeat, keys.upload, keys.view))
    return [
        _rule(f"{who} sends", (INGRESS,), ("put",), sent),
        _rule(f"{who} receives", (INGRESS,), ("declare_subscriber", "query"), (job, hello)),
        _rule(f"{who} is live", (INGRESS,), ("liveliness_token",), (keys.live_worker(_ANY_RUN, worker),)),
        _rule(f"{who} gets", (EGRESS,), ("put", "reply", "declare_queryable"), (job, hello)),
    ]
