"""A receipt says what is true of its run, and its commands run as they are printed.
Tests analysis_verb.py."""

import json
import re
import shlex
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.cli import command_line
from dreamfleet.common.protocol.host_classes import NON_DETERMINISTIC
from dreamfleet.common.runs.effort import Effort
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_paths import CONTROLLER, JOURNAL
from dreamfleet.common.runs.run_provenance import RECEIPT, RunProvenance
from dreamfleet.common.runs.seeds import training_seeds
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.coordinator.storage.journal import Journal

RUNS = Path(__file__).parents[3] / "fixtures" / "runs"


@pytest.fixture
def change(tmp_path):
    shutil.copytree(RUNS / "reality", tmp_path / "runs" / "reality")
    Journal(tmp_path / "runs" / "reality" / JOURNAL).close()  # in the newest schema

    def change(*statements):
        with closing(sqlite3.connect(tmp_path / "runs" / "reality" / JOURNAL)) as connection, connection:
            for each in statements:
                connection.execute(*each)

    return change


@pytest.fixture
def printed(tmp_path, capsys):
    def call(*words):
        group = [] if words[0] == "compare" else ["runs"]
        assert command_line.main([*group, *words, "--runs-dir", str(tmp_path / "runs")]) == 0
        return capsys.readouterr().out

    return call


def test_failed_candidates_are_counted(change, printed):
    change(("UPDATE generation SET failed = 2 WHERE number < 2",))
    for verb in ("receipt", "show"):
        said = next(line for line in printed(verb, "reality").splitlines() if "--on-failure" in line)
        assert re.search(r"\b4\b", said)
        assert json.loads(printed(verb, "reality", "--json"))["failed_candidates"] == 4


def test_a_run_without_a_controller_says_why(change, tmp_path, capsys):
    change()
    (tmp_path / "runs" / "reality" / CONTROLLER).unlink()
    assert command_line.main(["runs", "receipt", "reality", "--runs-dir", str(tmp_path / "runs")]) == 1
    assert "reality" in capsys.readouterr().err


def test_replaced_seeds_are_counted(change, printed, tmp_path):
    with open_run(tmp_path / "runs", "reality") as run:
        later = training_seeds(run.settings.seed, 1, run.settings.episodes, 2)
    for count in (0, 2):
        for verb in ("receipt", "show"):
            assert json.loads(printed(verb, "reality", "--json"))["replaced_seeds"] == count
        change(("UPDATE generation SET seeds = ? WHERE number = 1", (json.dumps(later),)))
    change(("UPDATE generation SET seeds = '[0.5]' WHERE number = 1",))
    assert json.loads(printed("show", "reality", "--json"))["replaced_seeds"] == 0, "the rest is shown all the same"


def test_no_bits_are_promised_where_there_are_none(change, printed):
    def promised():
        return json.loads(printed("receipt", "reality", "--json"))["bit_identical"]

    assert promised() == {"candidate": True, "run": True}
    change(("UPDATE result SET host_class = 'another' WHERE generation = 1",))
    assert promised() == {"candidate": True, "run": False}
    change(("UPDATE result SET host_class = ?", (NON_DETERMINISTIC,)))
    assert promised() == {"candidate": False, "run": False}


def test_receipt_and_comparison_count_the_same_effort(change, printed, tmp_path):
    shutil.copytree(tmp_path / "runs" / "reality", tmp_path / "runs" / "other")
    change(("DELETE FROM run WHERE key IN ('ended', 'ended_at')",), ("UPDATE result SET steps = steps + 100",))
    spent = json.loads(printed("receipt", "reality", "--json"))["spent"]
    assert spent == json.loads(printed("compare", "reality", "other", "--json"))["runs"][0]["effort"]


def test_it_cites_the_software_in_the_version_that_served_the_run(change, printed, tmp_path):
    run = tmp_path / "runs" / "reality"
    found = Controller.load(run / CONTROLLER)
    found.provenance[RECEIPT] = to_plain(RunProvenance(3, Effort(), versions={"dreamfleet": "0.0.7"}))
    found.save(run / CONTROLLER)
    said, facts = printed("receipt", "reality"), json.loads(printed("receipt", "reality", "--json"))
    assert facts["software"] == {"title": "dreamfleet", "authors": "The dreamfleet authors", "version": "0.0.7"}
    entry = ["@misc{dreamfleet,", "  title = {dreamfleet},", "  author = {{The dreamfleet authors}},"]
    assert "\n".join([*entry, "  version = {0.0.7}", "}"]) in said


@pytest.mark.slow
def test_the_commands_of_a_run_in_an_environment_of_a_module_run_as_printed(processes):
    task, module = "gym:tests.support.dark_environments:Dark-v0", "tests.support.dark_environments"
    coordinator = processes.coordinator(
        "--task", task, "--population", 4, "--episodes", 1, "--generations", 1, "--evaluate-every", 0
    )
    processes.worker("--task", task, "--exit-when-done")
    assert coordinator.finish()[0] == 0
    code, out, err = processes.call("runs", "receipt", "test", "--runs-dir", processes.runs, "--json")
    assert code == 0, err
    commands = [shlex.split(each)[1:] for each in json.loads(out)["commands"].values()]
    assert [each[:2] for each in commands] == [["verify", "candidate"], ["verify", "run"], ["evaluate", "--controller"]]
    assert all(each[-2:] == ["--trust", module] for each in commands)
    for words in (commands[0], commands[2]):
        code, _, err = processes.call(*words)
        assert code == 0, err
