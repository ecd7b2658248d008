"""The control verbs that steer a run: pause, resume, drain, stop, disband, bar, unbar. No transport."""

import math
from collections.abc import Callable, Iterable

from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.messages import ControlReply
from dreamfleet.common.protocol.stop_kind import PauseKind
from dreamfleet.common.schema.validation import MAX_TEXT
from dreamfleet.coordinator.dispatch.member import Member
from dreamfleet.coordinator.dispatch.packing import SentBatch
from dreamfleet.coordinator.run.run import BY_HAND, Run
from dreamfleet.coordinator.run.run_state import Pause

LONGEST_VERB = 60  # characters of an unknown verb in the reply
LEAVING_VERBS = ("drain", "stop", "disband")
DRAINING = Pause(PauseKind.DRAINING, "draining")
DISBANDING = Pause(PauseKind.DISBANDING, "ending with its workers")
DISBAND_TIMEOUT = 10.0  # seconds that workers may take to leave a disbanded run


class Control:
    """Obeys control verbs, and sees draining and disbanding through until it calls `stop`."""

    def __init__(self, run: Run, name: str, beat: float, stop: Callable[[], None]) -> None:
        self._run = run
        self._name = name
        self._beat = beat
        self._stop = stop
        self._verbs: dict[str, Callable[[], str | None]] = {
            "pause": self._pause_by_hand,
            "resume": self._resume,
            "drain": self._drain,
            "stop": stop,
            "disband": self._disband,
            "bar": lambda: self._bar(is_barred=True),
            "unbar": lambda: self._bar(is_barred=False),
        }
        self._host = ""  # that the verb is about
        self._draining = False
        self._disbanding_since: float | None = None
        self._leave_sent_at = -math.inf
        self._now = 0.0

    @property
    def disbanding(self) -> bool:
        """Whether every batch asks its worker to leave."""
        return self._disbanding_since is not None

    def obey(self, query_key: str, resume_command: str, now: float, host: str = "") -> ControlReply:
        """Obey the verb of a query's key expression; an unknown one, or one for several runs, is refused.

        `bar` and `unbar` are about a `host`. A verb that cannot be obeyed now is refused with the reason.
        The reply to a verb that ends the coordinator holds `resume_command`.
        """
        self._now, self._host, verb = now, host, query_key.rsplit("/", 1)[-1]
        why, again = "", ""
        if query_key != keys.control(self._name, verb):  # docs/explanation/threats.md
            why = f"one run is controlled at a time, by its own key: query {keys.control(self._name, 'VERB')}"
        elif verb not in self._verbs:
            known = ", ".join(self._verbs)
            why = f"{truncate(verb, LONGEST_VERB)!r} is not a control verb of this version; known are {known}"
        else:
            why = truncate(self._verbs[verb]() or "", MAX_TEXT)
            if verb in LEAVING_VERBS and len(resume_command) <= MAX_TEXT and resume_command.isprintable():
                again = resume_command
        return ControlReply(v=keys.PROTOCOL_VERSION, run=self._name, accepted=not why, why=why, again=again)

    def advance(self, now: float) -> list[SentBatch]:
        """Stop once draining or disbanding is done; batches that ask the workers to leave, repeated every beat."""
        if self._draining and not self._run.fleet.lease_count:
            self._stop()
        if self._disbanding_since is None:
            return []
        present = [each for each in self._run.fleet.members.values() if each.gone_since is None]
        if not present or now - self._disbanding_since > DISBAND_TIMEOUT:
            self._stop()
        elif now - self._leave_sent_at >= self._beat:
            self._leave_sent_at = now
            return _empty_batches(present)
        return []

    def last_batches(self) -> list[SentBatch]:
        """Empty batches that say that the run has ended, for those present, which leave it."""
        return _empty_batches(each for each in self._run.fleet.members.values() if each.gone_since is None)

    def _pause_by_hand(self) -> str:
        self._run.pause(BY_HAND)
        if self._run.keep_paused():
            return ""
        return f"it is paused, and that cannot be written now: {self._run.obstacle}; it lasts once it is written"

    def _resume(self) -> str:
        self._draining = False
        return self._run.resume()

    def _bar(self, *, is_barred: bool) -> str:
        if self._draining or self.disbanding:
            return "the coordinator leaves: ask again once it is back, or with the name of the run on its disk"
        return self._run.bar(self._host, is_barred=is_barred)

    def _drain(self) -> None:
        self._draining = True
        self._run.pause(DRAINING)

    def _disband(self) -> None:
        self._run.pause(DISBANDING)
        self._disbanding_since = self._now


def _empty_batches(members: Iterable[Member]) -> list[SentBatch]:
    return [SentBatch(each.identity, each.numbering) for each in members]
