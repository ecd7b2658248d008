"""How the runs that one worker serves share its slots.

Weighted fair queueing (Demers, Keshav and Shenker 1989): a run pays for the seconds in which it holds slots, divided by
its share. A free slot goes to the waiting run that has paid least. A run that was idle for longer gets no
credit for that. Pages: share-a-fleet.md, operations-notes.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from threading import Lock
from time import monotonic

QUANTUM = 0.25  # slot seconds by which a run may be ahead of a waiting one, so that short jobs need not alternate
TIMEOUT = 0.1  # seconds for which a free slot waits for the run whose turn it is
RECENT = 2.0  # seconds after its last job for which a run counts as one that needs its share
GAP_CREDIT = 10.0  # slot seconds that a run is still owed after a gap below `RECENT`, as between two generations


@dataclass
class Account:
    """One run's part in the budget."""

    share: float
    paid: float  # slot seconds divided by the share, from the virtual time at which it became active
    worked_at: float  # when it last had a job
    owed: float = 0.0  # by how much it was behind the others when it last had no job
    held: int = 0  # slots that score for it
    wanted: int = 0  # further slots that it could fill now
    offered_at: float | None = None  # since when another run has waited for it to take a free slot

    @property
    def is_active(self) -> bool:
        """Whether it holds a slot or waits for one."""
        return self.held + self.wanted > 0


class SlotBudget:
    """Decides which run may use a slot. Pure: all `now` are seconds of one monotonic clock."""

    def __init__(self, slots: int) -> None:
        self._slots = slots
        self._accounts: dict[int, Account] = {}
        self._virtual_time = 0.0  # what the least paid active run has paid; it never falls
        self._charged_at = -math.inf

    def join(self, run: int, share: float, now: float) -> None:
        """Open an account for a run of this `share`."""
        self._charge(now)
        self._accounts[run] = Account(share, self._virtual_time, now)

    def leave(self, run: int, now: float) -> None:
        """Close a run's account and free its slots."""
        self._charge(now)
        self._accounts.pop(run, None)

    def settle(self, run: int, held: int, wanted: int, now: float, *, has_jobs: bool) -> None:
        """Note that a run holds `held` slots and could fill `wanted` more; `has_jobs`: some of its jobs are queued."""
        self._charge(now)
        account = self._accounts[run]
        if not (was_active := account.is_active):
            account.paid = max(account.paid, self._virtual_time - account.owed * (now - account.worked_at < RECENT))
        account.held, account.wanted, account.offered_at = held, wanted, None
        if was_active and not account.is_active:
            others = (each.paid for each in self._accounts.values() if each.is_active)
            behind = min(others, default=account.paid) - account.paid
            account.owed = min(max(behind, 0.0), GAP_CREDIT / account.share)
        if held or has_jobs:
            account.worked_at = now

    def take(self, run: int, now: float) -> bool:
        """Give a run one more slot; return whether one is free and no other run goes first."""
        self._charge(now)
        if not self._may_take(run, now):
            return False
        account = self._accounts[run]
        account.held, account.wanted = account.held + 1, max(account.wanted - 1, 0)
        return True

    def goes_on(self, run: int, now: float) -> bool:
        """Whether a run may use a slot that it holds for its next job too."""
        self._charge(now)
        return not self._ahead_of(run)

    def next_runs(self, run: int, now: float) -> list[int]:
        """The runs other than `run` that may take a slot now."""
        self._charge(now)
        return [
            each for each in self._accounts if each != run and self._accounts[each].wanted and self._may_take(each, now)
        ]

    def allowance(self, run: int, now: float) -> int:
        """The slots that a run can count on: its part by share, and what the others leave."""
        mine = self._accounts[run]
        others = [each for name, each in self._accounts.items() if name != run]
        needed = sum(each.share for each in others if each.is_active or now - each.worked_at < RECENT)
        if not needed:
            return self._slots
        left = self._slots - sum(each.held + each.wanted for each in others)
        return max(math.ceil(self._slots * mine.share / (mine.share + needed)), min(left, self._slots))

    def usable(self, run: int) -> int:
        """The slots that a run holds, and those that no run holds or waits for."""
        others = sum(each.held + each.wanted for name, each in self._accounts.items() if name != run)
        return max(self._accounts[run].held, self._slots - others)

    def busy_runs(self, now: float, within: float) -> int:
        """How many runs joined or had a job in the last `within` seconds."""
        return sum(now - each.worked_at < within for each in self._accounts.values())

    def _may_take(self, run: int, now: float) -> bool:
        """Whether a slot is free for a run.

        A run that goes first and takes nothing for `TIMEOUT` seconds does not count until it settles again: its thread
        may be waiting for a coordinator that does not answer.
        """
        free = self._slots - sum(each.held for each in self._accounts.values())
        if free <= 0:
            return False
        first = self._ahead_of(run)
        for each in first:
            each.offered_at = now if each.offered_at is None else each.offered_at
            if now - each.offered_at > TIMEOUT:
                each.wanted = 0
        return sum(each.wanted for each in first) < free

    def _ahead_of(self, run: int) -> list[Account]:
        """The waiting runs that go before this one."""
        mine = self._accounts[run]
        limit = mine.paid - QUANTUM / mine.share
        return [each for each in self._accounts.values() if each.wanted and each.paid < limit]

    def _charge(self, now: float) -> None:
        """Let each run pay for the slots that it held since the last call."""
        seconds, self._charged_at = max(now - self._charged_at, 0.0), max(now, self._charged_at)
        for each in self._accounts.values():
            if each.held:
                each.paid += each.held * seconds / each.share
        active = [each.paid for each in self._accounts.values() if each.is_active]
        self._virtual_time = max(self._virtual_time, min(active, default=0.0))


class SharedSlots:
    """A `SlotBudget` for the threads of several runs."""

    def __init__(self, slots: int) -> None:
        self.slots = slots
        self._budget = SlotBudget(slots)
        self._lock = Lock()
        self._numbers = count()
        self._wake: dict[int, Callable[[], None]] = {}

    def open(self, share: float, wake: Callable[[], None]) -> RunSlots:
        """A run's part of the budget; `wake` is called from any thread when the run should try to take a slot."""
        with self._lock:
            run = next(self._numbers)
            self._budget.join(run, share, monotonic())
            self._wake[run] = wake
        return RunSlots(run, self.slots, self._budget, self._lock, self._wake)

    def busy_runs(self, within: float) -> int:
        """How many runs joined or had a job in the last `within` seconds."""
        with self._lock:
            return self._budget.busy_runs(monotonic(), within)


class RunSlots:
    """One run's part of a worker's `SharedSlots`; `total` is the slots of all runs together."""

    def __init__(
        self, run: int, total: int, budget: SlotBudget, lock: Lock, wake: dict[int, Callable[[], None]]
    ) -> None:
        self.total = total
        self._run, self._budget, self._lock, self._wake = run, budget, lock, wake

    @property
    def allowance(self) -> int:
        """The slots that this run can count on now."""
        with self._lock:
            return self._budget.allowance(self._run, monotonic())

    @property
    def usable(self) -> int:
        """The slots that this run holds or could take now."""
        with self._lock:
            return self._budget.usable(self._run)

    def settle(self, held: int, wanted: int, *, has_jobs: bool) -> None:
        """Note how many slots score for this run, and how many more it could fill now."""
        with self._lock:
            self._budget.settle(self._run, held, wanted, monotonic(), has_jobs=has_jobs)

    def take(self) -> bool:
        """Take a slot; return whether this run may."""
        with self._lock:
            return self._budget.take(self._run, monotonic())

    def goes_on(self) -> bool:
        """Whether this run may use a slot that it holds for its next job too."""
        with self._lock:
            return self._budget.goes_on(self._run, monotonic())

    def pass_on(self) -> None:
        """Wake the other runs that may take a slot now."""
        with self._lock:
            wake = [self._wake[run] for run in self._budget.next_runs(self._run, monotonic())]
        for each in wake:
            each()

    def close(self) -> None:
        """Free this run's slots for the others."""
        with self._lock:
            self._budget.leave(self._run, monotonic())
            self._wake.pop(self._run, None)
            wake = list(self._wake.values())
        for each in wake:
            each()
