"""A coordinator's claim to its run's name on the network: of two coordinators of one name, one must leave."""

import queue
from contextlib import ExitStack, suppress
from time import monotonic, time
from typing import Any

import zenoh

from dreamfleet.common.errors import RefusedError
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import decode_json, encode_json
from dreamfleet.common.protocol.messages import ClaimNote
from dreamfleet.common.schema.validation import MalformedError
from dreamfleet.common.transport.session import LEASE_MS, enqueue_into
from dreamfleet.coordinator.service.leader_check import LeaderCheck

DISCOVERY_SECONDS = 0.3  # seconds until all present tokens are visible
TOKEN_TIMEOUT = LEASE_MS / 1000 + 1  # seconds: the token of a dead coordinator vanishes earlier
TIMEOUT = 2.0  # seconds of a query


class NameLock:
    """Holds the name and watches other coordinators' tokens; closing `stack` releases the name and ends the watch."""

    def __init__(self, session: zenoh.Session, run: str, nonce: str, stack: ExitStack) -> None:
        self._run = run
        self._nonce = nonce
        self._stack = stack
        self._watch(session)

    def _watch(self, session: zenoh.Session, own_note: ClaimNote | None = None) -> None:
        self._session = session
        self._leader_check = LeaderCheck(self._nonce, TOKEN_TIMEOUT, own_note)
        self._inbox: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        watcher = session.liveliness().declare_subscriber(
            keys.live_coordinator(self._run, "*"), enqueue_into(self._inbox, "token"), history=True
        )
        self._stack.callback(watcher.undeclare)

    def acquire(self, *, linked: bool) -> None:
        """Take the name; `RefusedError` if a live coordinator has it: a newcomer has nothing to lose.

        Unless `linked` to other routers, a router that just opened sees nobody, and waits for nobody.
        """
        until = monotonic() + (DISCOVERY_SECONDS if linked else 0.0)
        while (now := monotonic()) < until or self._leader_check.has_any:
            self._listen(now, DISCOVERY_SECONDS / 10)
            if self._leader_check.live(now):
                raise RefusedError(f"run {self._run} has a live coordinator already: stop it, or choose another --run")
        self._show_token()

    def move(self, session: zenoh.Session) -> None:
        """Hold the name on another session, as after a link that returned; the old one's stack is closed by then."""
        self._watch(session, self._leader_check.own_note)
        self._show_token()
        self._answer_claims()

    def _show_token(self) -> None:
        token = self._session.liveliness().declare_token(keys.live_coordinator(self._run, self._nonce))
        self._stack.callback(token.undeclare)

    def announce(self, run_uid: str, incarnation: int) -> None:
        """Identify this coordinator from now on, to every other one that asks."""
        note = ClaimNote(run_uid=run_uid, incarnation=incarnation, nonce=self._nonce, began=time())
        self._leader_check.own_note = note
        self._answer_claims()

    def _answer_claims(self) -> None:
        key, payload = keys.claim(self._run, self._nonce), encode_json(self._leader_check.own_note)
        inbox = self._inbox

        def answer(query: zenoh.Query) -> None:
            """Answer in Zenoh's thread: the service's loop may be busy."""
            with query:
                if query.payload is not None:  # the asking coordinator identifies itself
                    inbox.put(("note", query.payload.to_bytes()))
                query.reply(key, payload, encoding="application/json")

        queryable = self._session.declare_queryable(key, zenoh.handlers.Callback(answer, indirect=False))
        self._stack.callback(queryable.undeclare)

    def check(self, now: float) -> None:
        """Raise `RefusedError` if another coordinator of this name continues, so that this one must leave."""
        self._listen(now, 0.0)
        found = self._leader_check.find_stronger(now)
        if found is not None:
            raise RefusedError(self._explain(found[1]))

    def _listen(self, now: float, wait: float) -> None:
        """Handle tokens and notes, waiting at most `wait` seconds for the first; ask new coordinators for theirs."""
        with suppress(queue.Empty):
            while True:
                self._handle(*self._inbox.get(timeout=wait), now)
                wait = 0.0
        for nonce in self._leader_check.due_to_ask(now):
            self._ask(nonce)

    def _handle(self, kind: str, event: Any, now: float) -> None:
        if kind == "note":
            with suppress(MalformedError):
                self._leader_check.record_note(decode_json(ClaimNote, event))
            return
        nonce = str(event.key_expr).rsplit("/", 1)[-1]
        if event.kind == zenoh.SampleKind.DELETE:
            self._leader_check.vanish(nonce)
        else:
            self._leader_check.appear(nonce, now)

    def _ask(self, nonce: str) -> None:
        def record_note(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._inbox.put(("note", reply.ok.payload.to_bytes()))

        own = self._leader_check.own_note
        self._session.get(
            keys.claim(self._run, nonce), zenoh.handlers.Callback(record_note, indirect=False), timeout=TIMEOUT,
            payload=None if own is None else encode_json(own), encoding="application/json",
        )  # fmt: skip

    def _explain(self, other: ClaimNote | None) -> str:  # docs/how-to/troubleshooting.md
        own = self._leader_check.own_note
        same = other is not None and own is not None and other.run_uid == own.run_uid
        who = "of another version" if other is None else f"in incarnation {other.incarnation}"
        what = "this very run" if same else f"a run {self._run}"
        remedy = (
            "continue only one copy of a run: stop the other one first, or rename this one's folder"
            if same
            else "stop the other one, rename this run's folder, or keep their routers apart"
        )
        return (
            f"another coordinator serves {what} on this network, {who}: it continues, this one leaves; nothing is "
            f"lost, the journal is whole; {remedy}, then --resume"
        )
