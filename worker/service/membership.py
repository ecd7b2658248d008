"""Whether a worker belongs to its run, must say hello again, or leaves. Pure: a clock and events in, decisions out.

Nobody is told reliably that he was forgotten. A coordinator forgets a worker whose liveliness token vanishes, and a cut
of the connection makes each side's token vanish for the other. So a worker says hello again whenever that may have
happened: the joined coordinator was out of sight, another life of it is in sight, or it has been silent although it
owes an answer. To say hello once too often costs a message; to be forgotten would cost a host.

A worker leaves when it was told to (the first time it drains: what runs is finished and delivered), when its lifetime
is over (it drains too), when the run ends with its workers, or, where it was asked to, when it has seen no coordinator
for `GONE` seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

GONE = 5.0  # seconds without a coordinator after which a run counts as over
SILENT_BEATS = 5  # in which a coordinator that knows this worker would have answered
UPLOAD_GRACE = 30.0  # seconds more while a drive is on its way: no verdict is due before it is there


@dataclass(frozen=True)
class Terms:
    """When a worker leaves by itself."""

    lifetime: float = 0.0  # seconds from its start, after which it drains; 0: never
    drain_timeout: float = 30.0  # seconds that a drain may take
    leaves_alone: bool = False  # whether it leaves a run whose coordinator is gone


@dataclass(frozen=True)
class Hands:
    """What a worker has in its hands, from which follows whether its coordinator's silence means anything."""

    idle: bool  # it could score, and nothing runs: it would have been given work
    owed: bool  # it has results without a verdict: they would have been judged
    uploading: bool  # a drive is on its way, which delays the verdict


class Membership:
    """One worker's life, through one run after another; every method that takes a `now` takes the same clock's."""

    def __init__(self, terms: Terms, now: float) -> None:
        self._terms = terms
        self._ends_at = now + (terms.lifetime or math.inf)
        self._told_to_stop = 0
        self._drain_until: float | None = None
        self.join("", 0.0, now)

    def stop(self) -> None:
        """It was told to stop: once to drain, twice to leave at once. Safe in a signal handler."""
        self._told_to_stop += 1

    def join(self, nonce: str, beat: float, now: float) -> None:
        """It has joined a run, in the life `nonce` of its coordinator, who hears a beat every so many seconds."""
        self._beat = beat
        self._coordinators: set[str] = set()
        self._disbanded = False
        self._alone_since: float | None = now  # until a coordinator's token says otherwise
        self._ask_at = now
        self.rejoin(nonce, now)

    def rejoin(self, nonce: str, now: float) -> None:
        """The run has welcomed it again, perhaps in another life of its coordinator."""
        self._nonce = nonce
        self._parted = False  # the joined coordinator was out of sight, and may have given this worker up
        self._quiet_since = now

    def doubt(self) -> None:
        """Somebody says that this worker's batches are counted anew; only an answer to hello makes it true."""
        self._parted = True

    def ask(self, now: float, pause: float) -> None:
        """It says hello again; if nobody answers, the next time is at least `pause` seconds away."""
        self._ask_at = now + pause

    def hear(self, now: float) -> None:
        """The coordinator spoke, or a slot did: what it says is news that an answer is due to."""
        self._quiet_since = now

    def disband(self) -> None:
        """The joined run ends, and its workers with it."""
        self._disbanded = True

    def appear(self, nonce: str) -> bool:
        """A coordinator's token of the joined run came into sight; whether it is the joined life's that is back."""
        back = self._parted and nonce == self._nonce and nonce not in self._coordinators
        self._coordinators.add(nonce)
        self._alone_since = None
        return back

    def vanish(self, nonce: str, now: float) -> None:
        """A coordinator's token went out of sight."""
        self._coordinators.discard(nonce)
        self._parted |= nonce == self._nonce
        if not self._coordinators and self._alone_since is None:
            self._alone_since = now

    def leaving(self, now: float) -> bool:
        """Whether it takes nothing on any more: no job, and no other run."""
        return self._told_to_stop > 0 or now >= self._ends_at

    @property
    def leaves_alone(self) -> bool:
        """Whether it leaves a run whose coordinator is gone."""
        return self._terms.leaves_alone

    @property
    def draining(self) -> bool:
        """Whether what runs is being finished."""
        return self._drain_until is not None

    def must_drain(self, now: float) -> bool:
        """Whether to begin to drain; true once in a life."""
        if self.draining or not self.leaving(now):
            return False
        self._drain_until = now + self._terms.drain_timeout
        return True

    def over(self, now: float, busy: bool) -> bool:
        """Whether to leave the run now; `busy` while anything runs or is not delivered."""
        if self._told_to_stop > 1 or self._disbanded:
            return True
        if self._drain_until is not None:
            return not busy or now > self._drain_until or self._alone(now)
        return self._terms.leaves_alone and self._alone(now)

    def _alone(self, now: float) -> bool:
        """Whether no coordinator was in sight for so long that none is waited for."""
        return self._alone_since is not None and now - self._alone_since > GONE

    def must_rejoin(self, now: float, hands: Hands) -> bool:
        """Whether to say hello again: a coordinator is there, and may not know this worker."""
        if not self._coordinators or now < self._ask_at:
            return False
        if self._parted or self._nonce not in self._coordinators:
            return True
        patience = SILENT_BEATS * self._beat + (UPLOAD_GRACE if hands.uploading else 0.0)
        return now - self._quiet_since > patience and (hands.idle or hands.owed)
