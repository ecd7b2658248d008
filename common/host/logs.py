"""What is logged on stderr: one line an event, for people, or as JSON for programs.

A record may carry `facts`, what it tells by name (`extra={"facts": {...}}`): text leaves them out, JSON has them.
"""

from __future__ import annotations

import json
import logging
import sys
from datetime import UTC, datetime
from typing import Literal

from dreamfleet.common.printable import PrintableFormatter, one_line


class JsonFormatter(logging.Formatter):
    """A record as one line of JSON: time (UTC, ISO 8601), level, logger, message, then its facts."""

    def format(self, record: logging.LogRecord) -> str:
        """The line; JSON itself escapes whatever a terminal would obey."""
        time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        told = {"time": time, "level": record.levelname.lower(), "logger": record.name, "message": record.getMessage()}
        if record.exc_info:
            told["exception"] = self.formatException(record.exc_info)
        return json.dumps({**told, **getattr(record, "facts", {})}, default=str)


def configure_logging() -> None:
    """Log on stderr as text, until the settings say more."""
    handler = logging.StreamHandler()
    handler.setFormatter(PrintableFormatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)


def set_log_format(wanted: Literal["text", "json", "auto"]) -> None:
    """Log as text or JSON from now on; `auto` is text where a person reads stderr."""
    if wanted == "json" or (wanted == "auto" and not sys.stderr.isatty()):
        for handler in logging.getLogger().handlers:
            if isinstance(handler.formatter, PrintableFormatter):  # our own
                handler.setFormatter(JsonFormatter())


def report_failure(text: str) -> None:
    """Why a verb ends, on stderr: a line for people, or in the log where that is JSON."""
    if any(isinstance(handler.formatter, JsonFormatter) for handler in logging.getLogger().handlers):
        logging.getLogger("dreamfleet").error("%s", text)
    else:
        print(f"dreamfleet: {one_line(text)}", file=sys.stderr)  # noqa: T201 - the command line's answer
