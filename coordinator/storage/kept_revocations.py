"""The revoked seats of a run's fleet, kept in its journal: they hold wherever and however the run is continued.

A fact of the journal, as JSON: a list of seats for each authority, by the hash of its certificate. Pages: security.md.
"""

import json
from collections.abc import Collection

from dreamfleet.common.errors import JournalError
from dreamfleet.common.schema.validation import MalformedError, from_plain
from dreamfleet.coordinator.storage.journal import Journal

REVOKED = "revoked"  # the fact's name


class KeptRevocations:
    """The revoked seats of one authority in a run's journal."""

    def __init__(self, journal: Journal, authority: str) -> None:
        self._journal, self._authority = journal, authority
        self._kept = _parse(journal.fact(REVOKED))

    def keep(self, seats: Collection[str]) -> None:
        """Add revoked seats; durable with the journal's next commit."""
        known = self._kept.get(self._authority, ())
        if not set(seats) <= set(known):
            self._kept[self._authority] = tuple(sorted({*known, *seats}))
            self._journal.set_fact(REVOKED, json.dumps(self._kept))


def revoked_seats_in(fact: str | None, authority: str) -> frozenset[str]:
    """The revoked seats of an authority, such as `worker.17`, in a journal's fact; `JournalError` if it is damaged."""
    return frozenset(_parse(fact).get(authority, ()))


def _parse(fact: str | None) -> dict[str, tuple[str, ...]]:
    try:
        return from_plain(dict[str, tuple[str, ...]], json.loads(fact or "{}"))
    except (ValueError, RecursionError, MalformedError) as error:
        raise JournalError(f"the journal's list of revoked files is damaged ({error}): restore a copy") from error
