"""The state of a run and its named transitions: values that know no clock, no journal and no fleet.

`docs/reference/protocol.md` draws them. Pages: status.md, troubleshooting.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NoReturn

from dreamfleet.common.errors import InternalError
from dreamfleet.common.protocol.stop_kind import PauseKind, StopReason


@dataclass(frozen=True)
class Pause:
    """Why a run pauses; with `until_host` it goes on by itself once a host is here that may score."""

    kind: PauseKind
    text: str
    until_host: bool = False


class RunState:
    """What a run does now. A transition returns the next state; `InternalError` if this state does not have it."""

    def pause(self, pause: Pause) -> RunState:
        """Give out no more jobs until `resume`; what paused the run before is kept behind `pause`."""
        match self:
            case Running() | Ending():
                return Paused((pause,), self)
            case Paused(pauses):
                others = (each for each in pauses if each.kind is not pause.kind)
                return self if pauses[0].kind is pause.kind else replace(self, pauses=(pause, *others))
            case Stalled(then=then):
                return replace(self, then=then.pause(pause))
        return self._refuse("pause")

    def resume(self) -> RunState:
        """Go on as before all pauses."""
        match self:
            case Running() | Ending():
                return self
            case Paused(then=then):
                return then
            case Stalled(then=then):
                return replace(self, then=then.resume())
        return self._refuse("resume")

    def reach_limit(self, reason: StopReason) -> Ending:
        """Score no more candidates: only evaluations, kept rollouts and the confirmation remain."""
        return Ending(reason) if isinstance(self, Running) else self._refuse("reach_limit")

    def end(self) -> Ended:
        """Want nothing more: all that remained is done, be it in a pause."""
        match self:
            case Ending(reason) | Paused(then=Ending(reason)):
                return Ended(reason)
        return self._refuse("end")

    def rewind(self) -> RunState:
        """Leave the run to the next incarnation, which goes on from an earlier point of the journal."""
        match self:
            case Running() | Ending() | Paused() | Ended():
                return Rewound()
            case Stalled(then=then):
                return replace(self, then=then.rewind())
        return self._refuse("rewind")

    def stall(self, why: str, retry_at: float) -> Stalled:
        """Wait until the journal can be written, which is tried at `retry_at`, seconds of the run's clock."""
        return Stalled(why, retry_at, self.settled)

    def recover(self) -> RunState:
        """Go on, for the journal was written."""
        return self.then if isinstance(self, Stalled) else self._refuse("recover")

    def _refuse(self, transition: str) -> NoReturn:
        raise InternalError(f"a run that is {type(self).__name__} has no transition {transition}")

    @property
    def settled(self) -> RunState:
        """The state without the stall."""
        return self.then if isinstance(self, Stalled) else self

    @property
    def gives_jobs(self) -> bool:
        """Whether workers are given jobs."""
        return isinstance(self, Running | Ending)

    @property
    def is_over(self) -> bool:
        """Whether this incarnation does nothing more for the run but to write what it has."""
        return isinstance(self.settled, Ended | Rewound)

    @property
    def is_rewound(self) -> bool:
        """Whether the next incarnation goes on from an earlier point of the journal."""
        return isinstance(self.settled, Rewound)

    @property
    def ended(self) -> StopReason | None:
        """Why the run has ended; `None` if it has not."""
        return self.settled.reason if isinstance(self.settled, Ended) else None

    @property
    def reached(self) -> StopReason | None:
        """The limit that ends the run or has ended it; `None` while none is reached."""
        match self.settled:
            case Ending(reason) | Ended(reason) | Paused(then=Ending(reason)):
                return reason
        return None

    @property
    def paused(self) -> Paused | None:
        """What `resume` ends; `None` if the run is not paused."""
        return self.settled if isinstance(self.settled, Paused) else None

    @property
    def is_leaving(self) -> bool:
        """Whether this incarnation goes as soon as its workers are done, or gone: only what they do is of interest."""
        leaving = {PauseKind.DRAINING, PauseKind.DISBANDING}
        return self.paused is not None and not leaving.isdisjoint(each.kind for each in self.paused.pauses)

    @property
    def stalled(self) -> Stalled | None:
        """What `recover` ends; `None` if the journal can be written."""
        return self if isinstance(self, Stalled) else None


@dataclass(frozen=True)
class Running(RunState):
    """It scores generations, or waits for workers or a batch."""


@dataclass(frozen=True)
class Ending(RunState):
    """A limit is reached: only evaluations, kept rollouts and the confirmation remain."""

    reason: StopReason


@dataclass(frozen=True)
class Paused(RunState):
    """Workers are given no jobs. `pauses` has one of each kind at most, the latest first."""

    pauses: tuple[Pause, ...]
    then: Running | Ending  # what it goes on as

    @property
    def text(self) -> str:
        """Why, in words."""
        return "; before: ".join(each.text for each in self.pauses)

    @property
    def until_host(self) -> bool:
        """Whether a host that may score ends the pause."""
        return self.pauses[0].until_host


@dataclass(frozen=True)
class Ended(RunState):
    """It wants nothing more. Until the coordinator leaves, a host can still be barred, so that the run goes on."""

    reason: StopReason


@dataclass(frozen=True)
class Rewound(RunState):
    """What it holds in memory is true no more: results were recalled."""


@dataclass(frozen=True)
class Stalled(RunState):
    """The journal cannot be written now; `then` is the state once it can."""

    why: str
    retry_at: float  # seconds of the run's clock
    then: RunState  # not stalled
