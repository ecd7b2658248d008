"""A run of several stages with real workers: the same bits through kills, each stage replayed and shown."""

import json

import pytest

from tests.support import tasks
from tests.support.processes import call_here
from tests.support.same_bits import outcome

GENERATIONS, BEGUN = 8, [0, 4, 6]
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
def begin(processes, small):
    path = processes.folder / "stages.toml"
    path.write_text(STAGES)

    def coordinator(name):
        return processes.coordinator(
            *small, "--task", tasks.TOY, "--population", 5, "--episodes", 2, "--evaluate-every", 2,
            "--evaluation-episodes", 3, "--generations", GENERATIONS, "--schedule", path, name=name,
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
    for number in (2, None, 5, 6):
        if number is None:
            coordinator.wait_for_event("next stage")
        else:
            coordinator.wait_for_event("generation", number=number)
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
        words = ("verify", "candidate", "night", "--runs-dir", processes.runs, "--candidate", f"{generation}/1")
        code, out, err = call_here(*words)
        assert (code, "DIFFERS" in out) == (0, False), err
    _, out, err = call_here("runs", "show", "night", "--runs-dir", processes.runs, "--json")
    assert [each["since"] for each in json.loads(out)["stages"]] == BEGUN, err


def test_a_schedule_is_frozen_with_its_run_and_another_file_is_refused(processes, begin):
    begin("night").end()
    schedule = processes.folder / "stages.toml"
    resumed = ("coordinator", "--resume", "night", "--runs-dir", processes.runs)
    code, _, err = call_here(*resumed, "--schedule", schedule)
    assert (code, "--schedule" in err) == (2, True), err
    other = processes.folder / "other.toml"
    for text, warned in ((STAGES, False), (STAGES.replace("generations = 2", "generations = 3"), True)):
        other.write_text(text)
        coordinator = processes.resume("night", "--config", other)
        coordinator.wait_for_event("begin")
        coordinator.end()
        assert bool(coordinator.events("kept", setting="schedule")) == warned
