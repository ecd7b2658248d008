"""A run with an archive: its elites can be listed, drawn, judged and exported.
Tests coordinator/addons/quality_diversity/archive_plot.py."""

import json

import numpy as np
import pytest

import dreamfleet
from dreamfleet.common.addons.analysis.elites import RunArchive
from dreamfleet.common.runs.run_folder import open_run
from tests.support import tasks
from tests.support.processes import call_here

AXES = ("action0=-0.5:0.5:6", "action1=-0.5:0.5:6")
POPULATION = 6


@pytest.mark.slow
def test_the_elites_of_a_run_are_shown_drawn_judged_and_exported(processes, small):
    coordinator = processes.coordinator(
        *small, "--task", tasks.TOY, "--population", POPULATION, "--episodes", 2, "--sigma0", 0.2, "--generations", 5,
        "--archive", *AXES, "--optimiser", "map-elites",
    )  # fmt: skip
    processes.worker("--task", tasks.TOY)
    assert coordinator.finish()[0] == 0
    with open_run(processes.runs, "test") as run:
        vectors = np.stack([run.candidate(each.number, i) for each in run.history() for i in range(POPULATION)])
        archive = RunArchive.of(run)
        assert len(run.measured_candidates()) == 5 * POPULATION

    def call(*words):
        code, out, err = call_here(*words, "--runs-dir", processes.runs)
        assert code == 0, err
        return out, err

    facts = json.loads(call("runs", "show", "test", "--json")[0])["archive"]
    assert (facts["cells"], facts["filled"]) == (36, len(archive.elites))
    assert facts["best"]["fitness"] == archive.best.fitness
    cell = ",".join(map(str, archive.best.cell))
    _, note = call("evaluate", "--controller", "test", "--cell", cell, "--episodes", 1)
    assert archive.describe_elite(archive.best) in note
    picture, folder = processes.folder / "archive.svg", processes.folder / "tables"
    call("runs", "plot", "test", "--kind", "archive", "--out", picture)
    assert picture.stat().st_size > 5_000
    with dreamfleet.open_run("test", processes.runs) as run:
        frame, figure = run.to_pandas("elites"), run.plot("archive")
    assert len(frame) == len(archive.elites)
    assert list(frame.columns)[:3] == ["cell.action0", "cell.action1", "action0"]
    axes = figure.axes[0]
    numbers = [[label.get_text() for label in each.get_xticklabels()] for each in (axes, axes.child_axes[0])]
    assert numbers == [["-0.5", "-0.333", "-0.167", "0", "0.167", "0.333", "0.5"], ["0", "1", "2", "3", "4", "5"]]
    assert f"--cell {cell}" in axes.get_title().replace("\n", " ")
    call("runs", "export", "test", "--csv", "--out", folder)
    with np.load(folder / "elites.npz") as elites:
        parameters = elites["parameters"][np.argmax(elites["fitness"])]
    assert np.array_equal(parameters, vectors[archive.best.generation * POPULATION + archive.best.candidate])


def test_an_archive_that_cannot_be_is_refused_before_there_is_a_run(processes):
    for arguments, says in (
        (("--optimiser", "cma-me"), "--archive"),
        (("--archive", "steps=5"), "'steps=5'"),
        (("--archive", "steps=0:9:9", "steps=0:9:9"), "--archive"),
        (("--archive", "steps=0:1:200", "gas=0:1:200"), "40,000"),
        (("--task", "dream", "--archive", "truth.speed=0:1:9"), "truth.speed"),
    ):
        code, _, err = call_here("coordinator", "--runs-dir", processes.runs, *arguments)
        assert code == 2, arguments
        assert says in err.strip().splitlines()[-1]
        assert not processes.runs.exists() or not any(processes.runs.iterdir())
