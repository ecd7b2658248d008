"""Logging on stderr, one line an event: as text or as JSON.

A record may carry named values (`extra={"facts": {...}}`): JSON includes them, text does not.
"""

from __future__ import annotations

import json
import logging
import sys
from datetime import UTC, datetime
from typing import Literal

from dreamfleet.common.printable import PrintableFormatter, one_line, shorten_words


class JsonFormatter(logging.Formatter):
    """A record as one line of JSON: time (UTC, ISO 8601), level, logger, message, then its facts."""

    def format(self, record: logging.LogRecord) -> str:
        """Format one record; JSON escapes control characters."""
        time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        line = {"time": time, "level": record.levelname.lower(), "logger": record.name, "message": record.getMessage()}
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps({**line, **getattr(record, "facts", {})}, default=str)


def configure_logging() -> None:
    """Log warnings on stderr as text, until the settings are read."""
    handler = logging.StreamHandler()
    handler.setFormatter(PrintableFormatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)


def set_log_format(log_format: Literal["text", "json", "auto"]) -> None:
    """Log as text or JSON from now on; `auto` is text in a terminal, else JSON."""
    if log_format == "json" or (log_format == "auto" and not sys.stderr.isatty()):
        for handler in logging.getLogger().handlers:
            if isinstance(handler.formatter, PrintableFormatter):  # not a handler of somebody else
                handler.setFormatter(JsonFormatter())


def report_failure(text: str) -> None:
    """Report why a verb fails: as a line on stderr, or as a log record if the log is JSON."""
    text = shorten_words(one_line(text))
    if any(isinstance(handler.formatter, JsonFormatter) for handler in logging.getLogger().handlers):
        logging.getLogger("dreamfleet").error("%s", text)
    else:
        print(f"dreamfleet: {text}", file=sys.stderr)  # noqa: T201 - the command line's output
