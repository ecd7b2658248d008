"""What `runs show` prints of a run's settings. Tests verb.py and run_details.py."""

import json
import re
import sqlite3
from contextlib import closing
from dataclasses import replace

from dreamfleet.common.cli import command_line
from dreamfleet.common.client.equal_fitness import ENOUGH, EqualFitness
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.coordinator.addons.runs import run_details
from dreamfleet.coordinator.addons.runs.plot import fitness_figure
from tests.support.tables import cells


def show(capsys, runs, name):
    assert command_line.main(["runs", "show", name, "--runs-dir", str(runs)]) == 0
    return dict(row for line in capsys.readouterr().out.splitlines() if len(row := cells(line)) == 2)


def test_settings_that_do_not_apply_are_left_out_and_json_has_all(runs, capsys):
    few = show(capsys, runs, "reality")
    assert {"population", "sigma0", "seed", "task.horizon"} < few.keys()
    assert not {"task.recorded", "task.driven", "task.end", "driven", "task.temperature"} & few.keys()
    assert command_line.main(["runs", "show", "reality", "--runs-dir", str(runs), "--json"]) == 0
    every = json.loads(capsys.readouterr().out)["settings"]
    assert {"recorded", "driven", "end", "temperature"} < every["task"].keys()


def test_a_limit_of_the_environment_below_the_horizon_is_said(runs, capsys):
    with closing(sqlite3.connect(runs / "reality" / "journal.sqlite")) as journal:
        journal.execute("INSERT INTO run (key, value) VALUES ('episode_limit', '3')")
        journal.commit()
    assert re.search(r"\b3\b", show(capsys, runs, "reality")["task.horizon"])
    with open_run(runs, "reality") as run:
        assert re.search(r"\b3\b", fitness_figure(run).axes[0].get_ylabel())


def test_generations_of_one_fitness_are_warned_of(runs, capsys, monkeypatch):
    assert "warning" not in show(capsys, runs, "reality")
    monkeypatch.setattr(
        run_details, "EqualFitness", lambda rows: EqualFitness([replace(rows[0], worst=rows[0].best)] * ENOUGH)
    )
    assert "--sigma0" in show(capsys, runs, "reality")["warning"]
