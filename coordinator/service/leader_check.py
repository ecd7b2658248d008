"""Who of several coordinators of one name goes on. Pure: what is seen and said, and a clock in; who must leave out.

A token alone says little: it may linger after a coordinator that was killed. So each is asked who it is, and one that
does not answer counts only once its token has outlived the lease.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from dreamfleet.common.protocol.messages import ClaimNote

ASK_INTERVAL = 0.5  # seconds until one that did not answer is asked again


@dataclass
class OtherCoordinator:
    """Another coordinator's token."""

    since: float  # when it came into sight
    ask_at: float
    note: ClaimNote | None = None


@dataclass
class LeaderCheck:
    """The other coordinators in sight of one, by nonce; a silent one counts as live after `patience` seconds."""

    own_nonce: str  # this coordinator's nonce
    patience: float
    own_note: ClaimNote | None = None  # what this coordinator says of itself; `None` while it has not begun
    _seen: dict[str, OtherCoordinator] = field(default_factory=dict)

    def appear(self, nonce: str, now: float) -> None:
        """A token came into sight; one's own may come back after a cut, and is nobody's."""
        if nonce != self.own_nonce:
            self._seen.setdefault(nonce, OtherCoordinator(now, now))

    def vanish(self, nonce: str) -> None:
        """A token went out of sight."""
        self._seen.pop(nonce, None)

    def record_note(self, note: ClaimNote) -> None:
        """One says who it is, in answer or as it asks; an answer that comes after its token went means nothing."""
        if (rival := self._seen.get(note.nonce)) is not None:
            rival.note = note

    def due_to_ask(self, now: float) -> list[str]:
        """Whom to ask now."""
        found = [nonce for nonce, each in self._seen.items() if each.note is None and now >= each.ask_at]
        for nonce in found:
            self._seen[nonce].ask_at = now + ASK_INTERVAL
        return found

    @property
    def has_any(self) -> bool:
        """Whether any token is in sight."""
        return bool(self._seen)

    def live(self, now: float) -> list[tuple[str, ClaimNote | None]]:
        """Those that live: each one's nonce and what it said, `None` if it says nothing."""
        return [
            (nonce, each.note) for nonce, each in self._seen.items()
            if each.note is not None or now - each.since > self.patience
        ]  # fmt: skip

    def find_stronger(self, now: float) -> tuple[str, ClaimNote | None] | None:
        """One that goes on where this coordinator leaves; `None` while there is none.

        One that does not say who it is does not know this rule either, and will not leave.
        """
        for nonce, note in self.live(now):
            if note is None or self.own_note is None or rank(note) < rank(self.own_note):
                return nonce, note
        return None


def rank(note: ClaimNote) -> tuple[int, float, str]:
    """The lowest goes on: the latest incarnation, of equals the one that has served longest, of equals by nonce.

    Of one run the latest incarnation is the one that somebody continued last, and it holds what the earlier ones held
    when it was begun. The order is total, so that of any number exactly one goes on.
    """
    return -note.incarnation, note.began, note.nonce
