"""The state that the page keeps of live runs: what each worker did over the last minutes, too. Tests lanes.py
and stored_runs.py."""

import json
import time
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import pytest

from dreamfleet.common.addons.analysis.run_archive import RunArchive
from dreamfleet.common.client.elite_archive import Elite
from dreamfleet.common.client.status import ArchiveStatus
from dreamfleet.common.protocol.measures import parse_axes
from dreamfleet.common.protocol.messages import Result
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.transport.network import Network
from dreamfleet.coordinator.addons.dashboard import live_runs, stored_runs
from dreamfleet.coordinator.addons.dashboard.lanes import IDLE, LENGTH, LOST, SILENT, STRETCH, UNKNOWN, Lanes
from dreamfleet.coordinator.jobs.history import History
from dreamfleet.coordinator.service.snapshot import take_snapshot
from tests.support.processes import free_port
from tests.support.run_bench import SETTINGS, Bench
from tests.support.samples import STATUS
from tests.support.served import serving, snapshot


@pytest.fixture
def endpoint():
    return f"tcp/127.0.0.1:{free_port()}"


def watching(endpoint, runs, name="night"):
    return live_runs.Watcher(Network(connect=(endpoint,)), name, runs)


def look_of(watcher):
    while (shown := watcher.poll().find("night")) is None:
        pass  # a busy host may answer late
    return shown


def data_of(event):
    return json.loads(event.decode().split("data: ")[1])


def test_lanes_are_kept_while_polling_is_suspended(tmp_path, monkeypatch, endpoint):
    now = [1000.0]
    monkeypatch.setattr(live_runs, "time", SimpleNamespace(time=lambda: now[0], monotonic=time.monotonic))
    watcher = watching(endpoint, tmp_path, None)

    def lane():
        return data_of(look_of(watcher).page_state)["workers"]["lane"][0]

    with serving(endpoint, snapshot(4, workers=1)):
        seen = lane()[-1]
        for _ in range(2):
            watcher.suspend()
        now[0] += 3 * STRETCH
        assert lane()[-4:] == seen + 2 * UNKNOWN + seen
        watcher.suspend()


def test_a_run_by_name_is_followed_among_more_runs_than_the_page_holds(tmp_path, monkeypatch, endpoint):
    monkeypatch.setattr(live_runs, "MOST_RUNS", 1)
    watcher = watching(endpoint, tmp_path)
    with serving(endpoint, snapshot(4), snapshot(4, name="day")):
        look_of(watcher)
        assert watcher.poll().find("day") is None


def test_generations_that_were_recalled_and_scored_again_are_drawn_again(tmp_path, endpoint):
    watcher = watching(endpoint, tmp_path)
    first, again = snapshot(4), snapshot(4, incarnation=STATUS.incarnation + 1)
    again = replace(again, history=History(replace(each, mean=-7.5) for each in again.history.part(0, 4)).view())
    with serving(endpoint, first) as served:
        before = look_of(watcher)
        served.snapshot = again
        while (after := look_of(watcher)).curves == before.curves:
            pass
        watcher.suspend()
    assert [b"-7.5" in each.curves for each in (before, after)] == [False, True]


def test_a_live_runs_archive_is_drawn_from_its_journal_and_goes_on_after_a_restart(tmp_path, random_bundle, endpoint):
    axes = ("steps=0:4:4", "action0=0:1:2")
    spec = replace(SETTINGS.task, measures=("steps", "action0"))
    settings = replace(SETTINGS, task=spec, population=4, episodes=1, collect_every=0, archive=axes)
    bench = Bench(tmp_path / "night", random_bundle.path, settings, generations=3)

    def score(generations):
        while len(bench.run.history) < generations:
            for _, job in bench.fetch():
                place = job.candidate + job.generation
                bench.answer(Result(job.digest, float(place), 10, 0.1, None, None, measures=(place, 0.7)))

    score(1)
    bench.restart()  # what was found before is read from the journal
    score(2)
    looked = take_snapshot(bench.run, "night", Counter(), 0.0, bench.now)
    assert looked.status.archive == ArchiveStatus(8, 4, 0.0 + 1 + 2 + 4, 4.0, (3, 1))
    bench.journal.commit()
    watcher = watching(endpoint, tmp_path)
    with serving(endpoint, looked):
        shown = look_of(watcher)
        watcher.suspend()
    bench.journal.close()
    drawn = data_of(shown.curves)["archive"]
    assert drawn["z"] == [[None] * 4, [0.0, 1.0, 2.0, 4.0]]
    assert "4 of 8 cells filled" in drawn["caption"]
    tiles = {each["name"]: each["value"] for each in data_of(shown.page_state)["tiles"]}
    assert tiles["archive"] == "4 of 8"


def worker(name, rate=0.0, state="present", slots=1):
    return replace(STATUS.worker_list[0], worker=name, steps_per_second=rate, state=state, slots=slots)


def test_a_lane_shows_a_slots_speed_relative_to_the_fastest():
    lanes = Lanes()
    fleet = [worker("a/1", 90.0), worker("b/1", 90.0, slots=2), worker("c/1"), worker("d/1", state="silent"),
             worker("e/1", 5.0, state="lost")]  # fmt: skip
    lanes.update(fleet, 100.0)
    render = lanes.render(fleet)
    assert {len(lane) for lane in render} == {LENGTH}
    assert [lane[-1] for lane in render] == ["9", "4", IDLE, SILENT, LOST]


def test_a_slice_keeps_the_last_state():
    lanes, present, lost = Lanes(), worker("a/1", 10.0), worker("a/1", state="lost")
    lanes.update([present], 100.0)
    lanes.update([lost], 100.0 + 0.9 * STRETCH)
    assert lanes.render([lost])[0].strip() == LOST


def test_slices_without_an_update_are_unknown_and_old_ones_are_dropped():
    lanes, present = Lanes(), worker("a/1", 10.0)
    lanes.update([present], 100.0)
    lanes.update([present], 100.0 + 3 * STRETCH)
    assert lanes.render([present])[0].endswith("9  9")
    lanes.update([present], 100.0 + 1e6 * STRETCH)
    assert lanes.render([present])[0] == " " * (LENGTH - 1) + "9"


def test_a_clock_that_is_set_back_does_no_harm():
    lanes, present = Lanes(), worker("a/1", 10.0)
    assert lanes.render([present]) == [" " * LENGTH], "it was never seen"
    lanes.update([present], 1000.0)
    lanes.update([present], 10.0)
    assert lanes.render([present])[0].endswith("9")


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
