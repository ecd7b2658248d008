"""Logging on stderr, one line an event: as text or as JSON.

Text is short: the time of day, with the date in a day's first line, the level unless it is INFO, and who speaks. A
record may carry named values (`log_event`): JSON includes them, text does not. Pages: monitor.md.
"""

import json
import logging
import sys
from datetime import UTC, datetime
from typing import Literal

from dreamfleet.common.host.reports import FAILURE, report
from dreamfleet.common.printable import one_line, printable_lines, shorten_words

PROCESSES = ("coordinator", "worker")  # loggers whose lines are their process's


class TextFormatter(logging.Formatter):
    """A record as one line. `label` names this process among others in the same log: `run night`, `worker core-0`."""

    label = ""

    def __init__(self) -> None:
        super().__init__("%(message)s")
        self._day = ""

    def format(self, record: logging.LogRecord) -> str:
        """Format one record, printable."""
        day, time = (datetime.fromtimestamp(record.created).strftime(part) for part in ("%Y-%m-%d", "%H:%M:%S"))
        level = "" if record.levelno == logging.INFO else record.levelname
        package, _, rest = record.name.partition(".")
        speaker = rest.partition(".")[0] if package == "dreamfleet" and rest else record.name
        speaker = self.label if self.label and speaker in PROCESSES else speaker
        words = ["" if day == self._day else day, time, level, f"{speaker}: {super().format(record)}"]
        self._day = day
        return printable_lines(" ".join(filter(None, words)))


class JsonFormatter(logging.Formatter):
    """A record as one line of JSON: time (UTC, ISO 8601), level, logger, message, then its facts."""

    def format(self, record: logging.LogRecord) -> str:
        """Format one record; JSON escapes control characters."""
        time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        line = {"time": time, "level": record.levelname.lower(), "logger": record.name, "message": record.getMessage()}
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps({**line, **getattr(record, "facts", {})}, default=str)


def log_event(log: logging.Logger, event: str, text: str, *, level: int = logging.INFO, **facts: object) -> None:
    """Log `text`; in JSON with the name of the `event` and its `facts`."""
    log.log(level, "%s", text, extra={"facts": {"event": event, **facts}})


def configure_logging() -> None:
    """Log warnings on stderr as text, until the settings are read."""
    handler = logging.StreamHandler()
    handler.setFormatter(TextFormatter())
    logging.basicConfig(handlers=[handler], level=logging.WARNING)


def label_logs(label: str) -> None:
    """Name this process in its lines from now on, such as `worker core-0`."""
    TextFormatter.label = label


def set_log_format(log_format: Literal["text", "json", "auto"]) -> None:
    """Log as text or JSON from now on; `auto` is text in a terminal, else JSON."""
    if log_format == "json" or (log_format == "auto" and not sys.stderr.isatty()):
        for handler in logging.getLogger().handlers:
            if isinstance(handler.formatter, TextFormatter):  # not a handler of somebody else
                handler.setFormatter(JsonFormatter())


def report_failure(text: str) -> None:
    """Report why a verb fails: as a line on stderr, or as a log record if the log is JSON; and to who started it."""
    text = shorten_words(one_line(text))
    report(FAILURE, text)
    if any(isinstance(handler.formatter, JsonFormatter) for handler in logging.getLogger().handlers):
        logging.getLogger("dreamfleet").error("%s", text)
    else:
        print(f"dreamfleet: {text}", file=sys.stderr)  # noqa: T201 - the command line's output
