"""Who of several coordinators of one name goes on. Pure: what is seen and said, and a clock in; who must leave out.

A token alone says little: it may linger after a coordinator that was killed. So each is asked who it is, and one that
does not answer counts only once its token has outlived the lease.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from dreamfleet.common.messages import ClaimNote

ASK_AGAIN = 0.5  # seconds until one that did not answer is asked again


@dataclass
class Rival:
    """Another coordinator's token."""

    since: float  # when it came into sight
    ask_at: float
    said: ClaimNote | None = None


@dataclass
class Rivals:
    """The other coordinators in sight of one, by nonce; a silent one counts as live after `patience` seconds."""

    mine: str  # this coordinator's nonce
    patience: float
    claim: ClaimNote | None = None  # what this coordinator says of itself; `None` while it has not begun
    _seen: dict[str, Rival] = field(default_factory=dict)

    def appear(self, nonce: str, now: float) -> None:
        """A token came into sight; one's own may come back after a cut, and is nobody's."""
        if nonce != self.mine:
            self._seen.setdefault(nonce, Rival(now, now))

    def vanish(self, nonce: str) -> None:
        """A token went out of sight."""
        self._seen.pop(nonce, None)

    def hear(self, note: ClaimNote) -> None:
        """One says who it is, in answer or as it asks; an answer that comes after its token went means nothing."""
        if (rival := self._seen.get(note.nonce)) is not None:
            rival.said = note

    def to_ask(self, now: float) -> list[str]:
        """Whom to ask now."""
        found = [nonce for nonce, each in self._seen.items() if each.said is None and now >= each.ask_at]
        for nonce in found:
            self._seen[nonce].ask_at = now + ASK_AGAIN
        return found

    @property
    def any(self) -> bool:
        """Whether any token is in sight."""
        return bool(self._seen)

    def live(self, now: float) -> list[tuple[str, ClaimNote | None]]:
        """Those that live: each one's nonce and what it said, `None` if it says nothing."""
        return [
            (nonce, each.said) for nonce, each in self._seen.items()
            if each.said is not None or now - each.since > self.patience
        ]  # fmt: skip

    def stronger(self, now: float) -> tuple[str, ClaimNote | None] | None:
        """One that goes on where this coordinator leaves; `None` while there is none.

        One that does not say who it is does not know this rule either, and will not leave.
        """
        for nonce, said in self.live(now):
            if said is None or self.claim is None or rank(said) < rank(self.claim):
                return nonce, said
        return None


def rank(note: ClaimNote) -> tuple[int, float, str]:
    """The lowest goes on: the latest incarnation, of equals the one that has served longest, of equals by nonce.

    Of one run the latest incarnation is the one that somebody continued last, and it holds what the earlier ones held
    when it was begun. The order is total, so that of any number exactly one goes on.
    """
    return -note.incarnation, note.began, note.nonce
