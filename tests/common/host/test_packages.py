"""Packages of other projects, and the lines of a log. Tests logs.py."""

import json
import logging
import os
import re
import subprocess
import sys
from datetime import datetime
from importlib.metadata import packages_distributions, requires

import pytest

from dreamfleet.common.host import packages
from dreamfleet.common.host.logs import TextFormatter, label_logs
from dreamfleet.common.host.packages import find_distributions, hidden, wanted_versions, wrong_version


@pytest.mark.parametrize("module", ["numpy", "numpy.linalg", "zenoh", "Box2D.b2", "yaml", "six", "absent", "obj"])
def test_the_distributions_of_a_module_are_those_that_the_library_finds(module):
    assert find_distributions(module) == tuple(packages_distributions().get(module.partition(".")[0], ()))


def test_a_hidden_module_cannot_be_imported_inside_and_can_be_afterwards(monkeypatch):
    monkeypatch.delitem(sys.modules, "this", raising=False)
    with hidden("this", "json"):
        import json  # noqa: F401 - loaded before, so it stays

        with pytest.raises(ModuleNotFoundError):
            import this  # noqa: F401
    assert "this" not in sys.modules


@pytest.mark.parametrize("found", ["0.28.1", "1.3.9", "1.4", "1.4.0", "1.4.7rc1", "1.5.0", None])
def test_a_version_that_another_package_brought_is_found(found, monkeypatch):
    monkeypatch.setattr(packages, "requires", lambda _name: ["numpy<3,>=2.0", 'gymnasium<1.5,>=1.4; extra == "worker"'])
    monkeypatch.setattr(packages, "package_version", lambda _name: found)
    assert wanted_versions("gymnasium") == "gymnasium<1.5,>=1.4"
    for datum in ("gymnasium<1.5,>=1.4", "--no-deps"):
        assert (datum in wrong_version("gymnasium")) == (found in ("0.28.1", "1.3.9", "1.5.0"))
    assert not wrong_version("no-such-package")


def test_doctor_looks_for_all_that_every_role_requires():
    required = {re.match(r"[\w.-]+", each)[0] for each in requires("dreamfleet") if "extra ==" not in each}
    assert {name for name, (_, extra) in packages.PACKAGES.items() if not extra} == required


@pytest.mark.parametrize(
    "script",
    [
        "import dreamfleet.worker.worlds.car_racing.car",
        "import warnings\nwith warnings.catch_warnings():\n from dreamfleet.worker.worlds.car_racing import "
        "environment\nassert environment.find_reference()",
        "from dreamfleet.worker.worlds.gym.environments import make_environment as make; make('LunarLander-v3', {})",
        "from dreamfleet.common.host.trusted_modules import import_trusted; import_trusted('Box2D', 'a test')",
    ],
    ids=["CarRacing", "CarRacing, whose filters are gone", "gymnasium", "a module of the user"],
)
def test_box2d_is_imported_where_warnings_are_errors(script, monkeypatch):
    monkeypatch.setenv("DREAMFLEET_TRUST", "Box2D")
    command = [sys.executable, "-W", "error", "-c", script]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("task", ["gym:CartPole-v1", "function:math:fsum"])
def test_tasks_that_need_no_box2d_import_none(task, tmp_path):
    (tmp_path / "Box2D.py").write_text("import os; os.abort()")
    seen = {**os.environ, "PYTHONPATH": str(tmp_path), "PYTHONWARNINGS": "error"}
    command = [sys.executable, "-m", "dreamfleet", "tasks", task]
    done = subprocess.run(command, env=seen, check=False, capture_output=True, text=True, timeout=100)
    assert done.returncode in (0, 1), done.stderr


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
