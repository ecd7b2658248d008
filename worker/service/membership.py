"""Whether a worker belongs to its run, must say hello again, or leaves. Pure: a clock and events in, decisions out.

Nobody is told reliably that he was forgotten. A coordinator forgets a worker whose liveliness token vanishes, and a cut
of the connection makes each side's token vanish for the other. So a worker says hello again whenever that may have
happened: the joined coordinator was out of sight, another life of it is in sight, or it has been silent although it
owes an answer. To say hello once too often costs a message; to be forgotten would cost a host.

A worker leaves when it was told to (the first time it drains: what runs is finished and delivered), when its lifetime
is over (it drains too), when the run ends with its workers, or, where it was asked to, when it has seen no coordinator
for `COORDINATOR_GONE_AFTER` seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

COORDINATOR_GONE_AFTER = 5.0  # seconds without a coordinator after which a run counts as over
SILENT_BEATS = 5  # in which a coordinator that knows this worker would have answered
UPLOAD_GRACE = 30.0  # seconds more while a drive is on its way: no verdict is due before it is there


@dataclass(frozen=True)
class LeaveConditions:
    """When a worker leaves by itself."""

    lifetime: float = 0.0  # seconds from its start, after which it drains; 0: never
    drain_timeout: float = 30.0  # seconds that a drain may take
    leaves_without_coordinator: bool = False  # whether it leaves a run whose coordinator is gone


@dataclass(frozen=True)
class WorkerLoad:
    """What a worker has in its hands, from which follows whether its coordinator's silence means anything."""

    idle: bool  # it could score, and nothing runs: it would have been given work
    awaits_verdict: bool  # it has results without a verdict: they would have been judged
    uploading: bool  # a drive is on its way, which delays the verdict


class Membership:
    """One worker's life, through one run after another; every method that takes a `now` takes the same clock's."""

    def __init__(self, terms: LeaveConditions, now: float) -> None:
        self._terms = terms
        self._ends_at = now + (terms.lifetime or math.inf)
        self._stop_requests = 0
        self._drain_until: float | None = None
        self.join("", 0.0, now)

    def stop(self) -> None:
        """It was told to stop: once to drain, twice to leave at once. Safe in a signal handler."""
        self._stop_requests += 1

    def join(self, nonce: str, beat: float, now: float) -> None:
        """It has joined a run, in the life `nonce` of its coordinator, who hears a beat every so many seconds."""
        self._beat = beat
        self._coordinators: set[str] = set()
        self._run_has_ended = False
        self._no_coordinator_since: float | None = now  # until a coordinator's token says otherwise
        self._next_hello_at = now
        self.rejoin(nonce, now)

    def rejoin(self, nonce: str, now: float) -> None:
        """The run has welcomed it again, perhaps in another life of its coordinator."""
        self._nonce = nonce
        self._may_be_forgotten = False  # the joined coordinator was out of sight, and may have given this worker up
        self._silent_since = now

    def suspect_forgotten(self) -> None:
        """Somebody says that this worker's batches are counted anew; only an answer to hello makes it true."""
        self._may_be_forgotten = True

    def note_hello_sent(self, now: float, pause: float) -> None:
        """It says hello again; if nobody answers, the next time is at least `pause` seconds away."""
        self._next_hello_at = now + pause

    def note_activity(self, now: float) -> None:
        """The coordinator spoke, or a slot did: what it says is news that an answer is due to."""
        self._silent_since = now

    def end_run(self) -> None:
        """The joined run ends, and its workers with it."""
        self._run_has_ended = True

    def add_coordinator(self, nonce: str) -> bool:
        """A coordinator's token of the joined run came into sight; whether it is the joined life's that is back."""
        back = self._may_be_forgotten and nonce == self._nonce and nonce not in self._coordinators
        self._coordinators.add(nonce)
        self._no_coordinator_since = None
        return back

    def remove_coordinator(self, nonce: str, now: float) -> None:
        """A coordinator's token went out of sight."""
        self._coordinators.discard(nonce)
        self._may_be_forgotten |= nonce == self._nonce
        if not self._coordinators and self._no_coordinator_since is None:
            self._no_coordinator_since = now

    def is_leaving(self, now: float) -> bool:
        """Whether it takes nothing on any more: no job, and no other run."""
        return self._stop_requests > 0 or now >= self._ends_at

    @property
    def leaves_without_coordinator(self) -> bool:
        """Whether it leaves a run whose coordinator is gone."""
        return self._terms.leaves_without_coordinator

    @property
    def draining(self) -> bool:
        """Whether what runs is being finished."""
        return self._drain_until is not None

    def start_draining_if_due(self, now: float) -> bool:
        """Whether to begin to drain; true once in a life."""
        if self.draining or not self.is_leaving(now):
            return False
        self._drain_until = now + self._terms.drain_timeout
        return True

    def is_over(self, now: float, busy: bool) -> bool:
        """Whether to leave the run now; `busy` while anything runs or is not delivered."""
        if self._stop_requests > 1 or self._run_has_ended:
            return True
        if self._drain_until is not None:
            return not busy or now > self._drain_until or self._coordinator_is_gone(now)
        return self._terms.leaves_without_coordinator and self._coordinator_is_gone(now)

    def _coordinator_is_gone(self, now: float) -> bool:
        """Whether no coordinator was in sight for so long that none is waited for."""
        return self._no_coordinator_since is not None and now - self._no_coordinator_since > COORDINATOR_GONE_AFTER

    def must_rejoin(self, now: float, load: WorkerLoad) -> bool:
        """Whether to say hello again: a coordinator is there, and may not know this worker."""
        if not self._coordinators or now < self._next_hello_at:
            return False
        if self._may_be_forgotten or self._nonce not in self._coordinators:
            return True
        patience = SILENT_BEATS * self._beat + (UPLOAD_GRACE if load.uploading else 0.0)
        return now - self._silent_since > patience and (load.idle or load.awaits_verdict)
