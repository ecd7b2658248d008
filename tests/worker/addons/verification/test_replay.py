"""Tests replay.py, common/runs/run_paths.py and candidate_verb.py."""

import json

import pytest

from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.worker.addons.verification.replay import replay
from dreamfleet.worker.scoring.failure_cause import crash
from tests.support import rough_tasks, tasks
from tests.support.journals import change_journal
from tests.support.processes import call_here


@pytest.fixture
def begin(processes, random_bundle):
    """Score a run of one generation; its folder."""

    def begun(task, *flags, population=4, episodes=2):
        coordinator = processes.coordinator(
            "--bundle", random_bundle.path, "--task", task, "--population", population, "--episodes", episodes,
            "--generations", 1, "--evaluate-every", 0, *flags,
        )  # fmt: skip
        processes.worker("--task", task, "--exit-when-done")
        assert coordinator.finish()[0] == 0
        return processes.runs / "test"

    return begun


def verify(processes, candidate, *flags):
    """The exit code of `verify candidate`, what it prints, and its errors."""
    words = ("verify", "candidate", "test", "--runs-dir", processes.runs, "--candidate", candidate, *flags)
    code, out, err = call_here(*words)
    assert "Traceback" not in err
    return code, json.loads(out) if out and "--json" in flags else out, err


def same(found):
    """Whether each episode has the stored score again."""
    return [each["stored"] is not None and each["stored"] == each["replayed"] for each in found["episodes"]]


@pytest.mark.slow
def test_another_fitness_exits_1_and_one_of_another_host_class_is_counted_and_optionally_compared(processes, begin):
    finished_run = begin(tasks.TOY)
    code, found, _ = verify(processes, "0/1", "--json")
    assert (code, found["identical"], found["unchecked"], same(found)) == (0, True, 0, [True, True])
    change_journal(finished_run, "UPDATE candidate SET fitness = fitness + 0.25")  # more than the mean of its results
    code, found, err = verify(processes, "0/1", "--json")
    assert (code, found["identical"], same(found), err != "") == (1, False, [True, True], True)
    change_journal(finished_run, "UPDATE candidate SET fitness = fitness - 0.25")
    change_journal(finished_run, "UPDATE result SET fitness = fitness + 1e-9 WHERE candidate = 1 AND episode = 1")
    code, found, _ = verify(processes, "0/1", "--json")
    assert (code, found["identical"], found["unchecked"], same(found)) == (1, False, 0, [True, False])
    code, _, err = verify(processes, "5/0")
    assert (code, "5/0" in err) == (1, True)
    change_journal(finished_run, "UPDATE result SET fitness = fitness + 0.5, host_class = 'there' WHERE episode = 1")
    change_journal(finished_run, "UPDATE candidate SET fitness = fitness + 0.25")
    code, found, err = verify(processes, "0/1", "--json")
    assert (code, found["identical"], found["unchecked"], "--tolerance" in err) == (0, False, 1, True)
    code, out, err = verify(processes, "0/1", "--tolerance", 1)
    assert (code, len(out.splitlines()), out.count("there"), err) == (0, 2, 1, "")
    assert verify(processes, "0/1", "--tolerance", 0.25)[0] == 1


@pytest.mark.slow
def test_an_episode_that_hangs_or_ends_its_process_now_differs(begin, monkeypatch):
    with RunFolder(begin(rough_tasks.name_of(rough_tasks.Halting), episodes=3)) as run:
        seeds = [each.seed for each in run.results(0, 1)]
        monkeypatch.setenv(rough_tasks.HALT, str(seeds[0]))
        monkeypatch.setenv(rough_tasks.EXIT, str(seeds[1]))
        hung, crashed, sound = replay(run, 0, 1, stall=2.0)
    assert (hung.error.kind, crashed.error) == ("crash", crash(3))
    assert (hung.agrees(None), crashed.agrees(None), sound.agrees(None)) == (False, False, True)


@pytest.mark.slow
def test_an_episode_fails_only_in_a_fresh_process(processes, begin, monkeypatch):
    monkeypatch.setenv(rough_tasks.POISON, "fail")
    begin(rough_tasks.name_of(rough_tasks.Poisoned))
    code, found, err = verify(processes, "0/1", "--json")
    assert (code, same(found)) == (0, [True, True]), err


@pytest.mark.slow
@pytest.mark.parametrize("place", [pytest.param("make", marks=pytest.mark.long), "step"])
def test_what_only_python_itself_should_raise_is_an_episodes_failure(processes, begin, monkeypatch, place):
    begin(rough_tasks.name_of(rough_tasks.Raising))
    monkeypatch.setenv(rough_tasks.PLACE, place)
    monkeypatch.setenv(rough_tasks.ERROR, "KeyboardInterrupt")
    code, out, err = verify(processes, "0/1")
    assert (code, out.count("(KeyboardInterrupt")) == (1, 2), (out, err)


@pytest.fixture
def brittle_run(begin):
    def run(on_failure, seed=7, population=12):
        flags = ("--seed", seed, "--on-failure", on_failure, "--failure-limit", 1)
        return begin(tasks.BRITTLE, *flags, population=population, episodes=3)

    return run


@pytest.mark.slow
def test_a_candidate_that_failed_is_driven_again_its_cause_compared_and_one_that_scored_and_now_fails_differs(
    processes, brittle_run
):
    folder = brittle_run("worst")
    with RunFolder(folder) as run:
        place = run.failures()[0]
        failed = sum((each.generation, each.candidate) == (0, place.candidate) for each in run.failures())
    candidate = f"0/{place.candidate}"
    code, out, err = verify(processes, candidate)
    assert (code, out.count("(ArithmeticError: the world of")) == (0, 2 * failed), err
    _, found, _ = verify(processes, candidate, "--json")
    assert (found["identical"], found["fitness"], found["stored_fitness"]) == (True, None, None)
    change_journal(folder, "UPDATE failure SET cause = 'ValueError'")
    code, found, _ = verify(processes, candidate, "--json")
    assert (code, found["identical"]) == (1, False)
    change_journal(folder, "UPDATE failure SET cause = 'killed by SIGSEGV', fault = 'crash'")
    _, found, _ = verify(processes, candidate, "--json")
    assert [bool(each["error"]) for each in found["episodes"] if each["failure"]] == [False] * failed, "not driven"
    change_journal(
        folder, "INSERT INTO result (digest, kind, generation, candidate, episode, seed, fitness, steps, seconds, "
        "worker, fingerprint, incarnation, host_class) SELECT f.digest, f.kind, f.generation, f.candidate, f.episode, "
        "f.seed, -1.0, 10, 0.1, r.worker, r.fingerprint, r.incarnation, r.host_class FROM failure f, result r "
        "WHERE f.candidate = ? LIMIT 1", place.candidate,
    )  # fmt: skip
    change_journal(folder, "DELETE FROM failure")
    code, found, _ = verify(processes, candidate, "--json")
    assert code == 1
    assert any(each["stored"] == -1 and each["error"].startswith("ArithmeticError") for each in found["episodes"])


@pytest.mark.slow
def test_a_candidate_that_was_drawn_anew_is_compared_with_its_final_vector_alone(processes, brittle_run):
    with RunFolder(brittle_run("redraw")) as run:
        numbers = {each.candidate for each in run.failures()}
        stored = {number: len(run.results(0, number)) for number in numbers}
    number = max(stored, key=stored.__getitem__)
    assert stored[number] > 3, "choose another seed"
    code, found, err = verify(processes, f"0/{number}", "--json")
    assert (code, same(found)) == (0, [True] * 3), err


@pytest.mark.slow
def test_a_candidate_whose_generation_got_other_seeds_is_compared_on_these_alone(processes, brittle_run):
    folder = brittle_run("worst", seed=5, population=4)  # everybody fails on the second of its first three seeds
    with RunFolder(folder) as run:
        seeds = run.training_seeds(0)
        assert run.failures()[0].seed not in seeds
        number = next(number for number in range(4) if run.fitness(0, number) is not None)
    code, found, err = verify(processes, f"0/{number}", "--json")
    assert (code, same(found)) == (0, [True] * 3), err
    change_journal(folder, "UPDATE generation SET seeds = '7', checksum = NULL")
    assert verify(processes, f"0/{number}")[0] == 1
