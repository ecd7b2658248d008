"""Decide which of several coordinators of one name continues. Pure: tokens, notes and a clock in, a decision out.

A token alone proves little: it may outlive a killed coordinator. So each coordinator is asked to identify itself, and
one that does not answer counts only once its token has outlived the lease.
"""

from dataclasses import dataclass, field

from dreamfleet.common.protocol.messages import ClaimNote

ASK_INTERVAL = 0.5  # seconds before a coordinator that did not answer is asked again


@dataclass
class OtherCoordinator:
    """A coordinator whose token is visible."""

    since: float  # when its token appeared
    ask_at: float
    note: ClaimNote | None = None


@dataclass
class LeaderCheck:
    """The other visible coordinators, by nonce; a silent one counts as live after `timeout` seconds."""

    own_nonce: str  # this coordinator's nonce
    timeout: float
    own_note: ClaimNote | None = None  # identifies this coordinator; `None` until it serves a run
    _seen: dict[str, OtherCoordinator] = field(default_factory=dict)

    def appear(self, nonce: str, now: float) -> None:
        """A token appeared; this coordinator's own, which may return after a network cut, is ignored."""
        if nonce != self.own_nonce:
            self._seen.setdefault(nonce, OtherCoordinator(now, now))

    def vanish(self, nonce: str) -> None:
        """A token disappeared."""
        self._seen.pop(nonce, None)

    def record_note(self, note: ClaimNote) -> None:
        """A coordinator identified itself, in an answer or a query; after its token disappeared this means nothing."""
        if (rival := self._seen.get(note.nonce)) is not None:
            rival.note = note

    def due_to_ask(self, now: float) -> list[str]:
        """The nonces to ask now."""
        found = [nonce for nonce, each in self._seen.items() if each.note is None and now >= each.ask_at]
        for nonce in found:
            self._seen[nonce].ask_at = now + ASK_INTERVAL
        return found

    @property
    def has_any(self) -> bool:
        """Whether any other token is visible."""
        return bool(self._seen)

    def live(self, now: float) -> list[tuple[str, ClaimNote | None]]:
        """The live coordinators: each one's nonce and note, `None` if it does not answer."""
        return [
            (nonce, each.note)
            for nonce, each in self._seen.items()
            if each.note is not None or now - each.since > self.timeout
        ]

    def find_stronger(self, now: float) -> tuple[str, ClaimNote | None] | None:
        """A coordinator before which this one must leave; `None` if there is none.

        One that does not identify itself does not know this rule either, and will not leave.
        """
        for nonce, note in self.live(now):
            if note is None or self.own_note is None or rank(note) < rank(self.own_note):
                return nonce, note
        return None


def rank(note: ClaimNote) -> tuple[int, float, str]:
    """Sort key: the lowest continues. The latest incarnation ranks first, then the longest serving, then by nonce.

    The latest incarnation of a run is the one that was continued last, with all that the earlier ones held by then.
    R25: the order is total, so exactly one coordinator of a name stays, whatever each has seen.
    """
    return -note.incarnation, note.began, note.nonce
