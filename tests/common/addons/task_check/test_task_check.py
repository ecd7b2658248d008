"""Dry runs of real environments, each with one fault, in real child processes.
Tests dry_run_process.py, verb.py, worker/addons/task_check.py and worker/tasks/closing.py."""

import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from dreamfleet.common.addons.task_check import dry_run_process
from dreamfleet.common.addons.task_check.task_check import try_task
from tests.support.environments import DAEMON_FILE, ODD
from tests.support.processes import DEADLINE, ends, environment, started, until
from tests.support.stuck_environments import MODULE as STUCK


def dry_run(fault, name=ODD, **options):
    limit = options.pop("limit", 300)
    return try_task(name, {"environment": {"fault": fault}, **options}, limit)


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ("old step", " 4 "),
        ("old reset", "(2,)"),
        ("array", "(2,)"),
        ("infinite", "inf"),
        ("none", "NoneType"),
        ("nan", ""),
        ("raise", "RuntimeError: the engine stalled"),
        ("exit", "SystemExit: 3"),
        ("exit in peace", " 0"),
        ("exit at once", " 3"),
        ("crash", "(SIGSEGV)"),
        *((spoiled_pipes, "") for spoiled_pipes in (
            "close and hang", "big line", "line", "bytes", "nested", "null report", "steps", "flood")),
    ],
)  # fmt: skip
def test_a_fault_is_one_line_that_names_what_the_environment_did(fault, named, monkeypatch):
    monkeypatch.setattr(dry_run_process, "EXIT_GRACE", 1.0)
    found = dry_run(fault)
    assert found.description is None
    assert ODD in found.fault
    assert "\n" not in found.fault
    assert named in found.fault
    if fault == "old step":  # gymnasium's wrappers find it too
        assert named in dry_run(fault, ODD.replace("Odd-", "OddEndless-")).fault


@pytest.mark.slow
def test_a_hang_ends_at_the_limit():
    assert re.search(r"reset\(seed=0\).* 8", dry_run("hang", limit=8).fault)


@pytest.mark.parametrize("fault", ["random", "noise", "carry", "hash"])
def test_what_differs_between_equal_episodes_is_named_with_the_remedy(fault):
    found = dry_run(fault)
    assert (found.fault, found.compared) == ("", True)
    assert "self.np_random" in found.varies


def test_a_sound_environment_is_described_without_a_word():
    found = dry_run("noisy", normalise=True, seed=2**40)
    assert (found.fault, found.warnings, found.compared, found.varies) == ("", (), True, "")
    assert (found.description.observations, found.description.outputs) == (2, 2)
    assert '"normal"' in found.description.options


@pytest.mark.parametrize(("fault", "code"), [("checker", 4), ("checker in peace", 0)])
def test_gymnasiums_checker_only_warns(fault, code):
    assert any("not within the observation space" in text for text in dry_run("outside").warnings)
    found = dry_run(fault)  # the process is gone, and what was found before counts
    assert (found.fault, found.varies) == ("", "")
    (warning,) = found.warnings
    assert f" {code}" in warning


def test_what_is_left_out_is_named_unless_the_user_chose():
    task = "gym:tests.support.pixel_fakes:Telling-v0"
    assert [each for each in try_task(task, {}).warnings if "mission, notes.0" in each]
    found = try_task(task, {"observation": ["hand"]})
    assert (found.description.observations, found.warnings) == (3, ())


@pytest.mark.slow
def test_a_close_that_hangs_is_waited_for_once(tmp_path):
    file = tmp_path / "closed"
    found = try_task(f"gym:{STUCK}:StuckClose-v0", {"environment": {"file": str(file)}})
    assert (found.fault, found.varies, found.compared, len(found.warnings)) == ("", "", True, 1)
    assert file.read_text().splitlines() == ["closed"]


def test_a_picture_is_hinted_at_in_a_dict_by_its_key_and_once_and_a_table_of_codes_is_none():
    task = "gym:tests.support.pixel_fakes:InTwo-v0"
    found = try_task(task, {})
    assert len(set(found.warnings)) == len(found.warnings)
    assert [f"--task {task} --observation {key}" in text for key in ("map", "screen") for text in found.warnings
            if f"--observation {key}" in text] == [True, True]  # fmt: skip
    (only,) = (text for text in try_task(task, {"observation": ["map"]}).warnings if "--observation" in text)
    assert "--observation map" in only
    assert "--task gym:CarRacing-v3" in try_task("gym:CarRacing-v3", {}).warnings[0]
    assert not any("picture" in each for each in try_task("gym:tests.support.pixel_fakes:Board-v0", {}).warnings)


linux = pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="Linux")


@linux
@pytest.mark.parametrize(("fault", "error"), [("daemon", ""), ("daemon and raise", "RuntimeError: no licence")])
def test_a_daemon_that_keeps_the_pipes_ends_and_changes_no_finding(fault, error, tmp_path, monkeypatch):
    monkeypatch.setenv(DAEMON_FILE, str(tmp_path / "pid"))
    found = dry_run(fault)
    assert error in found.fault
    assert bool(found.fault) == bool(error)
    assert (found.varies, found.compared) == ("", not error)
    with suppress(ProcessLookupError):
        assert ends(os.pidfd_open(int((tmp_path / "pid").read_text())))


@linux
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_verb_with_all_that_the_environment_left(number, tmp_path):
    file: Path = tmp_path / "pid"
    with started(
        [sys.executable, "-m", "dreamfleet", "tasks", ODD, "--environment", 'fault="daemon and hang"'],
        env={**environment(tmp_path), DAEMON_FILE: str(file)}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    ) as verb:  # fmt: skip
        until(lambda: (file.exists() and file.read_text()) or verb.poll() is not None)
        daemon = os.pidfd_open(int(file.read_text()))
        verb.send_signal(number)
        printed, _ = verb.communicate(timeout=DEADLINE)
    assert verb.returncode != 0
    assert b"Traceback" not in printed
    assert ends(daemon)
