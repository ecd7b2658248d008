"""Logs as text and as JSON."""

import json
import subprocess
import sys

import pytest

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
    assert first.endswith("WARNING dreamfleet.x: said by a\\x1b[2J")
    assert last == "dreamfleet: why"


@pytest.mark.parametrize("wanted", ["json", "auto"])
def test_json_is_one_object_a_line_with_facts(wanted):
    first, last = map(json.loads, said(wanted))
    assert (first["level"], first["logger"], first["message"]) == ("warning", "dreamfleet.x", "said by a\x1b[2J\nb")
    assert (first["event"], first["mean"]) == ("one", 1.5)
    assert first["time"].endswith("+00:00")
    assert (last["level"], last["message"]) == ("error", "why")
