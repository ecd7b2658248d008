"""What `runs show` prints of a run's settings. Tests coordinator/addons/runs/verb.py and run_details.py."""

import json
import re
from dataclasses import replace

from dreamfleet.common.client.equal_fitness import ENOUGH, EqualFitness
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.addons.runs import run_details
from dreamfleet.coordinator.addons.runs.plot import fitness_figure
from tests.support.journals import change_journal
from tests.support.processes import printed
from tests.support.tables import cells


def shown():
    return dict(row for line in printed("runs", "show", "reality").splitlines() if len(row := cells(line)) == 2)


def test_settings_that_do_not_apply_are_left_out_and_json_has_all(runs):
    few = shown().keys()
    assert {"population", "sigma0", "seed", "task.horizon"} < few
    assert not {"task.recorded", "task.driven", "task.end", "driven", "task.temperature"} & few
    every = json.loads(printed("runs", "show", "reality", "--json"))["settings"]
    assert {"recorded", "driven", "end", "temperature"} < every["task"].keys()


def test_a_limit_of_the_environment_below_the_horizon_is_said(runs):
    change_journal(runs / "reality", "INSERT INTO run (key, value) VALUES ('episode_limit', '3')")
    assert re.search(r"\b3\b", shown()["task.horizon"])
    with RunFolder(runs / "reality") as run:
        assert re.search(r"\b3\b", fitness_figure(run).axes[0].get_ylabel())


def test_generations_of_one_fitness_are_warned_of(runs, monkeypatch):
    assert "warning" not in shown()
    monkeypatch.setattr(
        run_details, "EqualFitness", lambda rows: EqualFitness([replace(rows[0], worst=rows[0].best)] * ENOUGH)
    )
    assert "--sigma0" in shown()["warning"]
