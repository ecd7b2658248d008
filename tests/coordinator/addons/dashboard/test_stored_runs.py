"""The page's data from journals."""

import pytest

from dreamfleet.common.addons.analysis.elites import RunArchive
from dreamfleet.common.client.elites import Elite
from dreamfleet.common.protocol.measures import parse_axes
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.addons.dashboard import stored_runs


@pytest.fixture
def run(runs):
    with RunFolder(runs / "dream") as stored:
        yield stored


def test_quartiles_are_those_of_the_candidates_of_every_generation_that_is_drawn(run):
    found = stored_runs.read_quartiles(run, run.settings, run.history())
    assert found.keys() == {each.number for each in run.history()}
    for each in run.history():
        low, high = found[each.number]
        fitness = sorted(run.fitness(each.number, number) for number in range(run.settings.population))
        assert each.worst <= low <= high <= each.best
        below, above = sum(value <= low for value in fitness), sum(value >= high for value in fitness)
        assert below == above == round(len(fitness) / 4)


def test_a_run_whose_candidates_are_too_much_to_read_has_none(run, monkeypatch):
    monkeypatch.setattr(stored_runs, "MOST_READ", 10)
    assert stored_runs.read_quartiles(run, run.settings, run.history()) is None


def test_an_open_generation_has_no_quartiles(run):
    assert run.quartiles([len(run.history()), -1, 2**62]) == {}


def test_an_archive_is_described_for_its_heat_map_and_other_runs_have_none(runs):
    assert stored_runs.describe_run(runs, "reality")["archive"] is None
    axes = parse_axes(("speed=0:100:2", "braking=0:1:3"))
    elites = {(1, 2): Elite((1, 2), 4, 5, 7.5, (60.0, 0.9))}
    found = stored_runs.describe_archive(RunArchive(axes, elites))
    assert (found["x"], found["filled"]) == ([25.0, 75.0], 1)
    assert found["z"] == [[None, None], [None, None], [None, 7.5]]
    assert found["cells"] == [["", ""], ["", ""], ["", "1,2"]]
    assert "1 of 6 cells filled" in found["caption"]
    one = stored_runs.describe_archive(RunArchive(axes[:1], {}))
    assert (one["z"], one["y_title"], one["filled"]) == ([[None, None]], "", 0)
