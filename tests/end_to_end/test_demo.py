"""The demonstration, seconds long; and, long, that it gets somewhere whatever the seed.

Tests dreamfleet/experiments/demo.py and dreamfleet/experiments/verbs/demo.py.
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_paths import JOURNAL
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.experiments.demo import PLANS, Demo, DemoConfig, plan_runs
from dreamfleet.worker.addons.evaluation.known_score import median_drive
from tests.support.processes import call_here, runs
from tests.support.tables import cells


@pytest.mark.parametrize(
    ("drives", "expected"),
    [({5: 1.0}, 5), ({5: 1.0, 6: 3.0}, 5), ({5: 9.0, 6: 3.0, 7: 4.0}, 7), ({5: 9.0, 6: 3.0, 7: 4.0, 8: 384.0}, 7)],
)
def test_its_video_shows_the_median_track(drives, expected):
    assert median_drive(drives) == (expected, drives[expected])


@pytest.mark.parametrize(
    ("config", "subspace", "steps"),
    [
        (DemoConfig(), "tiny", [0.3, 0.15]),
        (DemoConfig(subspace="none"), None, [0.1, 0.06]),
        (DemoConfig(bundle="my.zip"), None, [0.1, 0.06]),
        (DemoConfig(bundle="my.zip", subspace="few.npz"), "few.npz", [0.3, 0.15]),
        (DemoConfig(dream_minutes=0), "tiny", [0.3]),
        (DemoConfig(sigma0=0.2), "tiny", [0.2, 0.15]),
    ],
)
def test_both_stages_search_in_the_features_that_ship_for_its_world_model(config, subspace, steps):
    found = plan_runs(config, "demo", Path("runs"))
    assert [each.flags["sigma0"] for each in found] == steps
    assert [each.flags.get("subspace") for each in found] == [subspace] * len(steps)
    assert all(("covariance" in each.flags) == bool(subspace) for each in found), "full in few dimensions"


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_it_dreams_drives_judges_plots_and_records(processes, random_bundle, monkeypatch):
    few = replace(PLANS["car-racing"], dream_evaluations=(2, 2, 2), real_evaluations=(3, 2, 3), video_steps=40)
    monkeypatch.setitem(PLANS, "car-racing", few)
    monkeypatch.setenv("COLUMNS", "120")
    code, out, err = call_here(
        "demo", "--run", "demo", "--runs-dir", processes.runs, "--port", processes.port, "--bundle", random_bundle.path,
        "--dream-minutes", 0.02, "--minutes", 0.02, "--horizon", 30, "--tracks", 1, "--population", 4,
    )  # fmt: skip
    assert code == 0, err
    with open_run(processes.runs, "demo-dream") as dream, open_run(processes.runs, "demo") as real:
        assert dream.settings.task.task == "dream"
        assert real.settings.task.task == "car-racing"
        assert dream.history()
        assert real.history()
        assert dream.evaluations()
        assert Controller.load(real.controller_path).bundle == random_bundle.sha256
        best = max((real, dream), key=lambda run: run.confirmation().mean).name
        found = [run.confirmation() for run in (real, dream)]
        confirmed = [f"{format_with_error(each.mean, each.error)} ({each.episodes})" for each in found]
        provenance = Controller.load((real if best == "demo" else dream).controller_path).provenance
    assert provenance["confirmed"]
    assert f"{best}/drive.mp4" in out
    assert all(score in out for score in confirmed), out
    table = [cells(line) for line in out.splitlines()]
    rows = [row for row in table if len(row) == 4 and row[0] in ("demo-dream", "demo")]
    assert [row[0] for row in rows] == ["demo-dream", "demo"]
    assert all(row[3].endswith(" (1)") for row in rows)
    assert "coordinator --run mine --preset dream --bundle" in out
    for made in (f"{best}/drive.mp4", "demo/fitness.png", "demo-dream/fitness.png"):
        assert (processes.runs / made).stat().st_size > 1000
    assert "http://127.0.0.1:" in out


@pytest.mark.parametrize("name", ["shown-dream", "shown"])
def test_a_run_of_its_name_is_refused_before_anything_begins(name, tmp_path, capsys):
    (tmp_path / name).mkdir()
    (tmp_path / name / JOURNAL).touch()
    assert main(["demo", "--run", "shown", "--runs-dir", str(tmp_path), "--no-page"]) == 2
    said = capsys.readouterr().err
    assert name in said
    assert "--run" in said
    assert [each.name for each in tmp_path.iterdir()] == [name]


def test_what_it_begins_is_of_no_other_fleet(monkeypatch):
    monkeypatch.setenv("DREAMFLEET_JOIN", "of-another-fleet.join")
    monkeypatch.setattr(Demo, "play", lambda _: joins.append(os.environ["DREAMFLEET_JOIN"]))
    joins = []
    assert main(["demo"]) == 0
    assert joins == [""]


@pytest.mark.slow
def test_stopped_without_a_page_it_had_none_leaves_nobody_and_says_how_to_go_on(processes, random_bundle):
    demo = processes.start(
        "demo", "--run", "demo", "--runs-dir", processes.runs, "--port", processes.port, "--bundle", random_bundle.path,
        "--workers", 1, "--no-page",
    )  # fmt: skip
    while not ((status := processes.status()) and status["workers"]["present"]):  # the page would have come before
        assert demo.popen.poll() is None
    started = psutil.Process(demo.popen.pid).children()
    words = [each.cmdline() for each in started]
    assert demo.stop()[0] == 130
    assert "--resume demo-dream" in demo.last_line()
    assert not any(runs(each.pid) for each in started)
    assert not any("dashboard" in each for each in words)


def test_a_name_that_no_run_can_have_makes_no_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("../x", "x" * 60):
        assert main(["demo", "--no-page", "--run", name, "--runs-dir", "runs"]) == 2
    assert list(tmp_path.iterdir()) == []


def improvement(run):
    """Last three generations over the first three, in standard errors of the difference of their candidates' means."""
    generations = len(run.history())
    fitness = np.array([[run.fitness(g, i) for i in range(run.settings.population)] for g in range(generations)])
    first, last = fitness[:3].ravel(), fitness[-3:].ravel()
    error = np.sqrt(first.var(ddof=1) / len(first) + last.var(ddof=1) / len(last))
    return (last.mean() - first.mean()) / error


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5])
def test_the_demo_improves_on_zero_parameters_by_two_standard_errors(processes, seed):
    code, out, err = processes.call(
        "demo", "--run", "demo", "--runs-dir", processes.runs, "--seed", seed, "--port", processes.port, "--tracks", 1,
        "--dream-minutes", 0, timeout=800,
    )  # fmt: skip
    assert code == 0, out + err
    with open_run(processes.runs, "demo") as run:
        assert improvement(run) > 2
        assert all((run.path / name).stat().st_size for name in ("controller.npz", "fitness.png", "drive.mp4"))
