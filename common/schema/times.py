"""Times as text: the clocks of hosts gave them, so one may be set back or forward, and one may be missing."""

from datetime import UTC, datetime

from dreamfleet.common.printable import printable


def parse_time(text: str) -> datetime | None:
    """The moment that ISO 8601 names, in UTC; `None` for another text."""
    try:
        return datetime.fromisoformat(text).astimezone(UTC)
    except (ValueError, OverflowError):
        return None


def elapsed_seconds(begun: str, ended: str) -> float | None:
    """Seconds between two moments; `None` if one is unknown, or if a clock was set back between them."""
    first, last = parse_time(begun), parse_time(ended)
    return None if first is None or last is None or last < first else (last - first).total_seconds()


def format_time(text: str) -> str:
    """Format a moment for people, such as 2026-11-23 17:30 UTC; another text stays as it is."""
    found = parse_time(text)
    return printable(text) if found is None else f"{found:%Y-%m-%d %H:%M} UTC"
