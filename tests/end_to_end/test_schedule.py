"""A run of several stages with real workers: the same bits through kills, each stage replayed and shown."""

import json

import pytest

from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.coordinator.addons.runs.plot import fitness_figure, save_figure
from dreamfleet.worker.addons.inspection.curve_sections import fitness_section
from tests.support import tasks
from tests.support.same_bits import outcome
from tests.support.tables import cells

GENERATIONS, BEGUN, SIZES = 8, [0, 4, 6], [5] * 4 + [7] * 4
STAGES = """
[[stage]]
score = -1000.0     # of any mean: that of generation 1 counts from generation 4 on
horizon = 4
patience = 3

[[stage]]
generations = 2
horizon = 7
patience = 0
population = 7
sigma0 = 0.3

[[stage]]
horizon = 10
episodes = 4
racing = true
"""


@pytest.fixture
def begin(processes, random_bundle):
    path = processes.folder / "stages.toml"
    path.write_text(STAGES)

    def coordinator(name, *flags):
        return processes.coordinator(
            "--bundle", random_bundle.path, "--task", tasks.TOY, "--population", 5, "--episodes", 2,
            "--evaluate-every", 2, "--evaluation-episodes", 3, "--generations", GENERATIONS, "--schedule", path, *flags,
            name=name,
        )  # fmt: skip

    return coordinator


@pytest.mark.slow
def test_a_run_of_three_stages_gives_the_same_bits_however_often_it_is_killed(processes, begin):
    coordinator = begin("calm")
    worker = processes.worker("--task", tasks.TOY, "--run", "calm")
    coordinator.wait_for_event("next stage", times=2)
    assert coordinator.finish()[0] == 0
    worker.end()
    coordinator = begin("night")
    for number in range(2):
        processes.worker("--task", tasks.TOY, "--run", "night", "--name", f"w{number}")
    generation = "generation"
    for event, facts in ((generation, {"number": 2}), ("next stage", {}), (generation, {"number": 5}),
                         (generation, {"number": 6})):  # fmt: skip
        coordinator.wait_for_event(event, **facts)
        coordinator.end()
        coordinator = processes.resume("night")
    assert coordinator.finish()[0] == 0
    calm = outcome(processes, "calm")
    assert calm == outcome(processes, "night")
    steps = [[steps for _, _, steps in episodes] for episodes in calm.episodes]
    assert steps[0] == [3, 3], "patience cuts what never is rewarded"
    assert {each for candidate in steps[4 * 5 : 4 * 5 + 2 * 7] for each in candidate} == {7}
    assert sorted(map(len, steps[-7:])) == [2] * 3 + [4] * 4
    for generation in (3, 4, 6):
        code, out, err = processes.call(
            "verify", "candidate", "night", "--runs-dir", processes.runs, "--candidate", f"{generation}/1"
        )
        assert (code, "DIFFERS" in out) == (0, False), err
    code, out, err = processes.call("runs", "show", "night", "--runs-dir", processes.runs)
    assert code == 0, err
    shown = [cells(line) for line in out.splitlines()]
    assert ["stage", "3 of 3"] in shown
    assert any(row[0] == "stage 2" and row[1].startswith("since generation 4, until 2 generations: ") for row in shown)
    code, out, err = processes.call("runs", "show", "night", "--runs-dir", processes.runs, "--json")
    assert [each["since"] for each in json.loads(out)["stages"]] == BEGUN
    picture = processes.folder / "fitness.png"
    with open_run(processes.runs, "night") as run:
        save_figure(fitness_figure(run), picture)
        text = fitness_section(run).text
    assert "4, then 7, then 10 steps an episode" in text
    assert picture.stat().st_size > 1000


def test_a_schedule_is_frozen_with_its_run_and_another_file_is_refused(processes, begin):
    begin("night").end()
    schedule = processes.folder / "stages.toml"
    resumed = ("coordinator", "--resume", "night", "--runs-dir", processes.runs, "--listen", processes.endpoint)
    code, _, err = processes.call(*resumed, "--schedule", schedule)
    assert code == 2
    assert "--schedule" in err
    other = processes.folder / "other.toml"
    for text, warned in ((STAGES, False), (STAGES.replace("generations = 2", "generations = 3"), True)):
        other.write_text(text)
        coordinator = processes.start(*resumed, "--config", other)
        coordinator.wait_for_event("begin")
        coordinator.end()
        assert bool(coordinator.events("kept", setting="schedule")) == warned
