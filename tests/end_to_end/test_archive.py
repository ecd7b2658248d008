"""A run with an archive: killed amid, it goes on to the same bits, and its elites can be listed, drawn and judged.
Tests coordinator/addons/quality_diversity/archive_plot.py."""

import json
import re
import signal
from contextlib import suppress

import numpy as np
import pytest
from playwright.sync_api import TimeoutError as SlowPageError

import dreamfleet
from dreamfleet.common.addons.analysis.elites import RunArchive
from dreamfleet.common.host.reports import ADDRESS
from dreamfleet.common.runs.run_folder import open_run
from tests.support import tasks
from tests.support.browser import chromium, tab
from tests.support.processes import DEADLINE, call_here

AXES = ("action0=-0.5:0.5:6", "action1=-0.5:0.5:6")
POPULATION = 6


@pytest.fixture
def settings(random_bundle):
    search = ("--population", POPULATION, "--episodes", 2, "--sigma0", 0.2, "--evaluate-every", 0, "--generations", 5)
    return ("--bundle", random_bundle.path, *search, "--archive", *AXES)


def recorded(processes, name):
    with open_run(processes.runs, name) as run:
        vectors = np.stack([run.candidate(each.number, i) for each in run.history() for i in range(POPULATION)])
        return vectors, run.measured_candidates(), RunArchive.of(run)


def check_page(processes, cell):
    """The page's heat map names a cell as `--cell` takes it, under the pointer."""
    served = processes.start("dashboard", "--connect", processes.endpoint, "--runs-dir", processes.runs, "--port", 0)
    address = re.search(r"http://[^/]+", served.wait_for_report(ADDRESS)).group()
    with chromium() as browser, tab(browser) as page:
        page.goto(f"{address}/#/run/whole")
        place, shown = page.locator("[data-part=archive] .nsewdrag"), page.locator("[data-part=archive] .hoverlayer")
        says = shown.filter(has_text=f"--cell {cell[0]},{cell[1]}")
        for _ in range(int(DEADLINE)):  # the chart may still change its size under the pointer
            place.scroll_into_view_if_needed()
            box = place.bounding_box()
            page.mouse.move(box["x"] - 20, box["y"])
            x, y = (cell[0] + 0.5) / 6, 1 - (cell[1] + 0.5) / 6
            page.mouse.move(box["x"] + box["width"] * x, box["y"] + box["height"] * y)
            with suppress(SlowPageError):
                says.wait_for(state="attached", timeout=1000)
                break
        assert says.count() == 1
    served.end()


@pytest.mark.slow
@pytest.mark.parametrize("optimiser", [pytest.param("cma-me", marks=pytest.mark.long), "map-elites"])
def test_a_killed_run_goes_on_to_the_same_archive(processes, settings, optimiser):
    flags = (*settings, "--optimiser", optimiser)
    whole = processes.coordinator(*flags, "--task", tasks.TOY, name="whole")
    processes.worker("--task", tasks.TOY, "--run", "whole")
    assert whole.finish()[0] == 0

    parts = processes.coordinator(*flags, "--task", tasks.SLOW_TOY, name="parts")
    processes.worker("--task", tasks.SLOW_TOY, "--run", "parts")
    parts.wait_for_event("generation", number=2)
    status = json.loads(processes.call("status", "parts", "--connect", processes.endpoint, "--json")[1])
    if status["generations"]:  # else nothing is closed in its snapshot yet
        assert 0 < status["archive"]["filled"] <= status["archive"]["cells"] == 36
    parts.popen.send_signal(signal.SIGKILL)
    parts.popen.wait()
    common = ("--runs-dir", processes.runs, "--listen", processes.endpoint, "--beat", "0.2")
    again = processes.start("coordinator", "--resume", "parts", "--generations", 5, *common)
    assert again.finish()[0] == 0
    (vectors, measured, archive), (other, other_measured, other_archive) = (
        recorded(processes, name) for name in ("whole", "parts")
    )
    assert np.array_equal(vectors, other)
    assert measured == other_measured
    assert len(measured) == 5 * POPULATION
    assert archive == other_archive

    runs = ("--runs-dir", processes.runs)
    code, out, _ = call_here("runs", "show", "whole", "--json", *runs)
    facts = json.loads(out)["archive"]
    assert code == 0
    assert (facts["cells"], facts["filled"]) == (36, len(archive.elites))
    assert facts["best"]["fitness"] == archive.best.fitness
    numbers = ",".join(map(str, archive.best.cell))
    note = call_here("evaluate", "--controller", "whole", "--cell", numbers, "--episodes", 1, *runs)[2]
    assert archive.describe_elite(archive.best) in note
    picture = processes.folder / "archive.svg"
    assert call_here("runs", "plot", "whole", "--kind", "archive", "--out", picture, *runs)[0] == 0
    assert "action0" in picture.read_text() or picture.stat().st_size > 5_000
    with dreamfleet.open_run("whole", processes.runs) as run:
        frame, figure = run.to_pandas("elites"), run.plot("archive")
    assert len(frame) == len(archive.elites)
    assert list(frame.columns)[:3] == ["cell.action0", "cell.action1", "action0"]
    map_axes = figure.axes[0]
    numbers = [[label.get_text() for label in each.get_xticklabels()] for each in (map_axes, map_axes.child_axes[0])]
    assert numbers == [["-0.5", "-0.333", "-0.167", "0", "0.167", "0.333", "0.5"], ["0", "1", "2", "3", "4", "5"]]
    title = map_axes.get_title().replace("\n", " ")
    assert f"--cell {archive.best.cell[0]},{archive.best.cell[1]}" in title
    if optimiser == "cma-me":
        check_page(processes, archive.best.cell)
    folder = processes.folder / "tables"
    assert call_here("runs", "export", "whole", "--csv", "--out", folder, *runs)[0] == 0
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
