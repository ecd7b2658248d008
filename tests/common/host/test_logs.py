import json
import logging
import re
import subprocess
import sys
from datetime import datetime

import pytest

from dreamfleet.common.host.logs import TextFormatter, label_logs

BEGIN = (
    "import logging; from dreamfleet.common.host.logs import configure_logging, set_log_format, report_failure; "
    "configure_logging(); "
)
SAY = (
    "log = logging.getLogger('dreamfleet.x'); "
    "log.warning('said by %s', 'a\\x1b[2J\\nb', extra={'facts': {'event': 'one', 'mean': 1.5}}); report_failure('why')"
)


def said(wanted):
    done = subprocess.run(
        [sys.executable, "-c", f"{BEGIN}set_log_format({wanted!r}); {SAY}"], capture_output=True, text=True, check=True
    )
    return done.stderr.splitlines()


def test_text_is_the_default_format():
    first, *_, last = said("text")
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d WARNING x: said by a\\x1b\[2J", first)
    assert last.endswith(" why")


def line(formatter, logger, created):
    record = logging.LogRecord(logger, logging.INFO, "", 0, "generation %d", (3,), None)
    record.created = created
    return formatter.format(record)


def test_a_line_has_the_time_of_day_and_a_days_first_one_the_date(monkeypatch):
    monkeypatch.setattr(TextFormatter, "label", "")
    formatter = TextFormatter()
    noon = datetime(2026, 11, 26, 12, 0, 5).timestamp()
    lines = [line(formatter, "dreamfleet.coordinator.service.run_log", noon + hours * 3600) for hours in (0, 1, 12, 13)]
    assert lines == [
        "2026-11-26 12:00:05 coordinator: generation 3",
        "13:00:05 coordinator: generation 3",
        "2026-11-27 00:00:05 coordinator: generation 3",
        "01:00:05 coordinator: generation 3",
    ]


def test_processes_that_share_a_log_are_told_apart(monkeypatch):
    monkeypatch.setattr(TextFormatter, "label", "")
    assert line(TextFormatter(), "dreamfleet.worker.service.slot", 0.0).endswith(" worker: generation 3")
    label_logs("worker core-1")
    for logger, speaker in {
        "dreamfleet.worker.service.slot": "worker core-1",
        "dreamfleet.coordinator": "worker core-1",
        "dreamfleet.router": "router",
        "matplotlib.font_manager": "matplotlib.font_manager",
        "dreamfleet": "dreamfleet",
    }.items():
        assert line(TextFormatter(), logger, 0.0).endswith(f" {speaker}: generation 3")


@pytest.mark.parametrize("wanted", ["json", "auto"])
def test_json_is_one_object_a_line_with_facts(wanted):
    first, last = map(json.loads, said(wanted))
    assert (first["level"], first["logger"], first["message"]) == ("warning", "dreamfleet.x", "said by a\x1b[2J\nb")
    assert (first["event"], first["mean"]) == ("one", 1.5)
    assert first["time"].endswith("+00:00")
    assert (last["level"], last["message"]) == ("error", "why")
