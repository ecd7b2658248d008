"""Whether a worker belongs to its run, must say hello again, or leaves. Pure: events and times in, decisions out.

A coordinator forgets a worker whose liveliness token vanishes. A cut connection makes the token of each side vanish for
the other, and neither side can reliably notify the other afterwards. Pages: share-a-fleet.md, exit-codes.md.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

NEXT_RUN_AFTER = 5.0  # seconds without a coordinator after which an idle worker of any run looks for another
NEXT_RUN_TIMEOUT = 60.0  # the same for one that has jobs or results of the run
SEARCH_INTERVAL = 5.0  # seconds without a coordinator after which, and then between which, it looks for its run
SILENT_BEATS = 5  # heartbeat intervals in which a coordinator that knows this worker would have answered
UPLOAD_GRACE = 30.0  # seconds more while a rollout is being sent: the verdict comes only after it
# Seconds until a run that refused is asked again: the first pause, and the longest; each refusal doubles it.
FIRST_DELAY, MAX_DELAY = 15.0, 600.0  # of a worker that may serve any run
SINGLE_RUN_DELAYS = 1.0, 60.0  # of a worker that serves one run


@dataclass(frozen=True)
class LeaveConditions:
    """When a worker leaves without being stopped."""

    lifetime: float = 0.0  # seconds from its start until it drains; 0: never
    drain_timeout: float = 30.0  # seconds that draining may take
    leaves_with_run: bool = False  # whether it leaves when its run has ended
    serves_any: bool = False  # whether it goes on to the next run, then and where the coordinator is gone
    coordinator_timeout: float = math.inf  # seconds without a coordinator after which it gives its run up
    is_expired: Callable[[], bool] = lambda: False  # by the wall clock, which goes on while this host sleeps


@dataclass(frozen=True)
class WorkerLoad:
    """Whether the coordinator owes this worker an answer, so that its silence means something."""

    idle: bool  # it could score and nothing runs: a coordinator would have given it work
    awaits_verdict: bool  # it has results without a verdict
    uploading: bool  # it is sending a rollout, which delays the verdict


class StopRequests:
    """How often a worker was asked to stop; all its memberships share it."""

    def __init__(self) -> None:
        self.count = 0


class Membership:
    """One worker in one run after another. All `now` arguments are of the same monotonic clock.

    `now` of the constructor is when the worker started: its lifetime counts from there.
    """

    def __init__(self, conditions: LeaveConditions, now: float, stops: StopRequests | None = None) -> None:
        self.conditions = conditions
        self._ends_at = now + (conditions.lifetime or math.inf)
        self._stops = stops or StopRequests()
        self._drain_until: float | None = None
        self.join("", 0.0, now)

    def stop(self) -> None:
        """Request a stop: once to drain, twice to leave at once. Safe in a signal handler."""
        self._stops.count += 1

    def join(self, nonce: str, beat: float, now: float) -> None:
        """Record that a run welcomed this worker: its coordinator's `nonce`, and the heartbeat interval `beat`."""
        self._beat = beat
        self._coordinators: set[str] = set()  # nonces of the coordinators in sight
        self.run_is_over = ""  # why the joined run is over and its workers leave; empty: it is not
        self.ending = ""  # how the joined run ended by a limit, in words; empty: it has not
        self._no_coordinator_since: float | None = now  # `None` while one is in sight
        self._next_hello_at = now
        self._next_search_at = now + SEARCH_INTERVAL
        self.rejoin(nonce, now)

    def rejoin(self, nonce: str, now: float) -> None:
        """Record that the run welcomed this worker again, perhaps in another incarnation of its coordinator."""
        self._nonce = nonce
        self._may_be_forgotten = False
        self._silent_since = now

    def suspect_forgotten(self) -> None:
        """Note that a batch of a newer numbering arrived.

        R12: such a batch only makes the worker say hello, because anybody could have sent it.
        """
        self._may_be_forgotten = True

    def note_hello_sent(self, now: float, pause: float) -> None:
        """Allow the next hello after `pause` seconds at the earliest."""
        self._next_hello_at = now + pause

    def note_activity(self, now: float) -> None:
        """Restart the silence: the coordinator sent something, or a slot did and the coordinator owes an answer."""
        self._silent_since = now

    def end_run(self, why: str, ending: str = "") -> None:
        """Record that the joined run is over and its workers leave; `ending` is how a limit ended it."""
        self.run_is_over, self.ending = why, ending

    def add_coordinator(self, nonce: str) -> bool:
        """Record that a coordinator came into sight; return whether it is the joined one that is back."""
        back = self._may_be_forgotten and nonce == self._nonce and nonce not in self._coordinators
        self._coordinators.add(nonce)
        self._no_coordinator_since = None
        return back

    def remove_coordinator(self, nonce: str, now: float) -> None:
        """Record that a coordinator's token vanished.

        R22: if it was the joined one, this worker's token may have vanished too, and with it its leases.
        """
        self._coordinators.discard(nonce)
        self._may_be_forgotten |= nonce == self._nonce
        if not self._coordinators and self._no_coordinator_since is None:
            self._no_coordinator_since = now
            self._next_search_at = now + SEARCH_INTERVAL

    def is_leaving(self, now: float) -> bool:
        """Whether this worker accepts neither another job nor another run."""
        return self._stops.count > 0 or now >= self._ends_at or self.conditions.is_expired()

    @property
    def plan_without_coordinator(self) -> str:
        """What it does while its coordinator is out of sight, in words."""
        if self.conditions.serves_any:
            after = f"{NEXT_RUN_AFTER:g} s, with results of it after {NEXT_RUN_TIMEOUT:g} s"
            return f"leaves this run after {after}, and serves others"
        if self.conditions.leaves_with_run:
            return f"leaves unless it is back within {self.conditions.coordinator_timeout:g} s"
        return "waits for this run only, even under another name (--any takes the next run)"

    @property
    def draining(self) -> bool:
        """Whether it only finishes what already runs."""
        return self._drain_until is not None

    def start_draining_if_due(self, now: float) -> bool:
        """Start to drain if it is time; return whether this call started it.

        R24: a worker that leaves first drains, so that no running job is lost and the queue is given away at once.
        """
        if self.draining or not self.is_leaving(now):
            return False
        self._drain_until = now + self.conditions.drain_timeout
        return True

    def find_end(self, now: float, busy: bool) -> str:
        """Why to leave the run now; empty: it stays. `busy` means that jobs run or results have no verdict.

        R24: a draining worker leaves once all is delivered, when its time is up, or, once it is stopped, if nobody is
        in sight who takes what is left. A run ends by its coordinator's word; silence alone may be a cut link or a
        restart, so it needs a long timeout.
        """
        if self._stops.count > 1:
            return "stopped by two signals, without draining"
        if self.run_is_over:
            return self.run_is_over
        if self._drain_until is not None:
            is_late = now > self._drain_until
            if busy and not is_late and not (self._stops.count and self._lacks_coordinator(now, SEARCH_INTERVAL)):
                return ""
            why = "drained after a stop signal" if self._stops.count else "drained at the end of its lifetime"
            when = "--drain-timeout was over" if is_late else "no coordinator was in sight"
            return f"{why}, but jobs or results were left when {when}" if busy else why
        if self.gives_up(now):
            return f"no coordinator was reachable for {self.conditions.coordinator_timeout:g} s"
        if self.conditions.serves_any and self._lacks_coordinator(now, NEXT_RUN_TIMEOUT if busy else NEXT_RUN_AFTER):
            return "it takes another run"
        return ""

    def gives_up(self, now: float) -> bool:
        """Whether the coordinator has been out of sight for so long that waiting for it makes no sense."""
        alone = self._lacks_coordinator(now, self.conditions.coordinator_timeout)
        return self.conditions.leaves_with_run and alone and not self.is_leaving(now)

    def _lacks_coordinator(self, now: float, seconds: float) -> bool:
        """Whether no coordinator has been in sight for longer than `seconds`."""
        return self._no_coordinator_since is not None and now - self._no_coordinator_since > seconds

    def start_search_if_due(self, now: float) -> bool:
        """Whether to look for the joined run under another name; the next look is due some seconds later."""
        if self._no_coordinator_since is None or now < self._next_search_at:
            return False
        self._next_search_at = now + SEARCH_INTERVAL
        return True

    def must_rejoin(self, now: float, load: WorkerLoad) -> bool:
        """Whether to say hello again.

        R22: it does so when the coordinator was out of sight, is in another incarnation, or is silent although it owes
        an answer. An extra hello costs one message; a forgotten worker would idle for good.
        """
        if not self._coordinators or now < self._next_hello_at:
            return False
        if self._may_be_forgotten or self._nonce not in self._coordinators:
            return True
        timeout = SILENT_BEATS * self._beat + (UPLOAD_GRACE if load.uploading else 0.0)
        return now - self._silent_since > timeout and (load.idle or load.awaits_verdict)


class RefusalBackoff:
    """The runs that refused this worker, with their reasons and pauses."""

    def __init__(self, first: float = FIRST_DELAY, longest: float = MAX_DELAY) -> None:
        self._first, self._longest = first, longest
        self._reasons: dict[str, str] = {}  # the last one of each run
        self._pause: dict[str, float] = {}
        self._until: dict[str, float] = {}

    def add(self, run: str, now: float) -> float:
        """Record a refusal; return the seconds until the run may be asked again.

        R23: a refused worker asks again for as long as it lives, because the reason may pass and anybody could have
        answered. Pauses grow, so that asking costs little.
        """
        pause = min(2 * self._pause.get(run, self._first / 2), self._longest)
        self._pause[run], self._until[run] = pause, now + pause
        return pause

    def is_news(self, run: str, reason: str) -> bool:
        """Whether a run refuses for another reason than the last time."""
        before = self._reasons.get(run)
        self._reasons[run] = reason
        return reason != before

    def forget(self, run: str) -> None:
        """Forget a run's refusals: it has accepted this worker."""
        for each in (self._reasons, self._pause, self._until):
            each.pop(run, None)

    def refusing_runs(self, now: float) -> set[str]:
        """Runs that must not be asked now."""
        return {run for run, until in self._until.items() if now < until}
