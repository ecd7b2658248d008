import json
import os
import subprocess
import sys

import pytest

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.host import reports
from dreamfleet.common.host.processes import VerbProcess
from tests.support.processes import DEADLINE

REPORTING = (
    "from dreamfleet.common.host.reports import VARIABLE, adopt_reports, report\nimport os\n"
    "adopt_reports()\nreport('address', ['here', 7])\nreport('failure', 'é\\n')\nprint(VARIABLE in os.environ)"
)


def test_a_failure_is_reported_whatever_the_log_looks_like(tmp_path):
    environment = {**os.environ, "DREAMFLEET_LOG_FORMAT": "json"}
    for log in (None, tmp_path / "new" / "child.log"):
        with VerbProcess("coordinator", "--resume", "absent", "--runs-dir", tmp_path, "--generations", 1, log=log,
                         environment=environment) as child:  # fmt: skip
            assert child.finish(DEADLINE)[0] == 1
        (failure,) = child.reports(reports.FAILURE)
        assert child.last_line() == failure
        assert "absent" in failure
        with pytest.raises(DreamfleetError, match=reports.ADDRESS):  # it ended: no endless wait
            child.wait_for_report(reports.ADDRESS, DEADLINE)


def test_reports_reach_a_file_and_end_with_the_process_and_a_place_that_is_not_there_costs_them_alone(tmp_path):
    path = tmp_path / "reports"
    for place in (path, "", "999", "/nowhere/at/all", "."):
        environment = {**os.environ, reports.VARIABLE: str(place)}
        done = subprocess.run([sys.executable, "-c", REPORTING], env=environment, capture_output=True, check=True)
        assert (done.stdout, done.stderr) == (b"False\n", b""), "what it starts reports nowhere"
    assert list(map(json.loads, path.read_text().splitlines())) == [{"address": ["here", 7]}, {"failure": "é\n"}]
    assert path.stat().st_mode & 0o777 == 0o600


def test_what_is_no_report_is_passed_over():
    pipe = reports.ReportPipe()
    os.write(pipe.write, b'7\n[1]\nnonsense\n\xff\n{"a": 1}\n{"a": 2, "b": null}\n{"a":')
    assert (pipe.find("a"), pipe.find("b"), pipe.find("c")) == ([1, 2], [None], [])
    os.write(pipe.write, b" 3}\n")
    os.close(pipe.write)
    assert pipe.find("a") == [1, 2, 3]
