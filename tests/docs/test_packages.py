"""CONTRIBUTING and CI install the programs of one list."""

import pytest

from tests.support import programs
from tests.support.processes import ROOT
from tests.support.programs import packages, require_programs

INSTALL = "apt-get install --no-install-recommends "


def test_contributing_installs_the_packages_of_the_list():
    (line,) = (line for line in (ROOT / "CONTRIBUTING.md").read_text().splitlines() if line.startswith(INSTALL))
    assert line.removeprefix(INSTALL).split() == sorted(packages().values())


def test_without_a_program_a_test_is_skipped_for_a_reason_that_all_share(monkeypatch):
    monkeypatch.setattr(programs, "SEARCHED", "/nowhere")
    monkeypatch.delenv("CI", raising=False)
    reasons = set()
    for name in packages():
        with pytest.raises(pytest.skip.Exception) as skipped:
            require_programs(name)
        reasons.add(str(skipped.value))
    (reason,) = reasons
    assert all(package in reason for package in packages().values())


def test_in_ci_it_fails(monkeypatch):
    monkeypatch.setattr(programs, "SEARCHED", "/nowhere")
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match="not installed: chromium"):
        require_programs("chromium")
