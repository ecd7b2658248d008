"""A run of several stages, against its journal, without a transport; a schedule as people write it.
Tests fork.py, run_setup.py and stage_tables.py."""

import argparse
import re
from dataclasses import replace
from importlib.metadata import version

import numpy as np
import pytest

from dreamfleet.common.cli.config import read_toml
from dreamfleet.common.cli.global_config import ARRAYS, TABLES
from dreamfleet.common.client.run_view import LiveRunView
from dreamfleet.common.errors import UsageError
from dreamfleet.common.runs.records import StageSettings
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.stages import begun_stages, stages_of
from dreamfleet.coordinator.jobs.scoring_job import vector_bytes
from dreamfleet.coordinator.optimisers.evolution import Evolution
from dreamfleet.coordinator.service.snapshot import take_snapshot
from dreamfleet.coordinator.settings.config import RunConfig, config_values
from dreamfleet.coordinator.settings.fork import Fork
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.run_setup import _with_stages, load_run_config
from dreamfleet.coordinator.settings.stage_tables import find_schedule, remaining_settings
from tests.support.dispatched import result
from tests.support.frozen_settings import comes_back
from tests.support.run_bench import SETTINGS, Bench
from tests.support.samples import SPEC

GENERATIONS = 11
EVERY = 2  # generations from one evaluation to the next
STAGES = (
    StageSettings(2),
    StageSettings(score=500.0, horizon=400, patience=0, episodes=2, racing=True),
    StageSettings(steps=150, population=8, horizon=600),
    StageSettings(sigma0=0.05),
)
STAGED = replace(SETTINGS, population=6, evaluate_every=EVERY, evaluation_episodes=2, collect_every=0, stages=STAGES)
REALITY = (900.0, 400.0, 510.0, 450.0, 350.0, 300.0, 300.0)  # of the means after generations 1, 3, 5, ...
BEGUN = [0, 2, 8, 10]  # the score of generation 5's mean counts from generation 8 on, and 12 x 10 steps come twice
SIZES = [6] * 8 + [8] * 4


class Staged(Bench):
    """Its means after generations 1, 3, 5, ... have the scores of `REALITY`; jobs are finished in any order."""

    def fitness_of(self, job):
        if job.kind == "score":
            return int.from_bytes(job.digest[:4], "little") / 1e6
        if job.generation % EVERY:
            return REALITY[job.generation // EVERY] + job.episode
        return 900.0  # of a mean that is evaluated because a limit was reached

    def first(self, kind):
        return next((index for index, job in enumerate(self.given) if job.kind == kind), None)

    def end(self, after=lambda: None):
        """What the scored jobs name of their specification, by generation."""
        found = {}
        while self.run.state.ended is None:
            self.fetch()
            found.update({job.generation: job.overrides for job in self.given if job.kind == "score"})
            self.finish()
            after()
        return found

    def outcome(self):
        with RunFolder(self.path) as run:
            numbers = [(number, index) for number in range(GENERATIONS) for index in range(SIZES[number])]
            found = [(run.candidate(*each).tobytes(), run.fitness(*each)) for each in numbers]
            kept = [(each.episode, each.seed, each.fitness) for place in numbers for each in run.results(*place)]
            begun = begun_stages(run.settings, run.history(), run.evaluations())
            return found, kept, [each for each in run.evaluations() if each.generation % EVERY], begun


@pytest.fixture
def staged(make_bench):
    return lambda generations=GENERATIONS, settings=STAGED: make_bench(Staged, settings, generations)


@pytest.fixture
def undisturbed(staged):
    bench = staged()
    named = bench.end()
    assert list(named.values()) == [(None, None, None)] * 2 + [(400, 0, None)] * 6 + [(600, 0, None)] * 3
    *_, begun = bench.outcome()
    assert [each.since for each in begun] == BEGUN
    return bench.outcome()


def test_a_run_that_ended_between_two_checks_and_goes_on_comes_to_the_same_stages(staged, undisturbed):
    bench = staged(generations=5)
    bench.end()
    bench.limits = LimitsConfig(generations=GENERATIONS)
    bench.restart()
    bench.end()
    assert bench.outcome() == undisturbed


def test_a_generation_waits_for_the_check_that_may_end_its_stage_and_for_no_other(staged, undisturbed):
    bench, waited = staged(), []
    while bench.run.state.ended is None:
        bench.fetch()
        scored = bench.first("score")
        if scored is None and bench.run.generation.complete:
            assert bench.run.fleet.drain_background, "every slot may drive the check"
            waited.append((bench.run.generation.number, {job.generation for job in bench.given}))
        bench.finish(0 if scored is None else scored)
    in_time = [(number, each) for number, each in waited if number < GENERATIONS - 1]
    assert {number for number, _ in in_time} == {5, 7}, "of the stage that a score may end, and asked in it"
    assert bench.outcome() == undisturbed


def test_a_restart_begins_at_the_first_mean_and_what_follows_at_the_best_also_after_a_kill(staged):
    again = StageSettings(3, score=1e6, restart=True)
    settings = replace(STAGED, stages=(StageSettings(3, score=1e6), again, again, StageSettings(sigma0=0.05)))
    calm, killed = staged(settings=settings), staged(settings=settings)
    calm.end()
    found = populations(calm)
    with RunFolder(calm.path) as run:
        begun = begun_stages(run.settings, run.history(), run.evaluations())
    assert [(each.stage.number, each.since) for each in begun] == [(1, 0), (2, 3), (3, 6), (4, 9)]
    best = np.frombuffer(calm.journal.evaluated_vector(1), "<f4").astype(float)
    starts = zip(begun, [None] * 3 + [best], strict=True)
    anew = [Evolution.of(settings, each.stage, None, at).ask() for each, at in starts]
    assert [found[each.since] for each in begun] == [list(map(vector_bytes, each)) for each in anew]
    assert found[0] != found[3] != found[6]
    while killed.run.state.ended is None:
        before = killed.run.generation.number
        killed.step()
        if killed.run.generation.number > before and killed.run.state.ended is None:
            killed.restart()
            assert killed.run.generation.number == before + 1
    assert populations(killed) == found


def populations(bench):
    with RunFolder(bench.path) as run:
        return [[run.candidate(number, index).tobytes() for index in range(6)] for number in range(GENERATIONS)]


def test_the_log_says_when_a_stage_begins_and_why(staged):
    bench = staged()
    bench.end()
    said = [note.text for note in bench.run.take_notes() if note.what in ("stage", "next stage")]
    for note, data in zip(said, ("1 of 4 .*1,000", "2 of 4 .*2", "3 of 4 .*5 .*510.5", "4 of 4 .*240"), strict=True):
        assert re.search(data, note)


def test_the_status_says_which_stage_it_is_and_what_counts_there(staged):
    bench, found = staged(), []
    bench.end(lambda: found.append(take_snapshot(bench.run, "night", {}, 0.0, 0.0).status))
    assert {each.package for each in found} == {version("dreamfleet")}
    seen = {(each.generation.stage.number, each.generation.stage.since) for each in found}
    assert seen == {(number, since) for number, since in enumerate(BEGUN, 1)}
    settings = LiveRunView.of_status(found[-1]).stage_settings
    assert (settings.task.horizon, settings.task.patience, settings.population, settings.episodes) == (600, 0, 8, 2)


def test_a_kept_drive_is_driven_as_the_candidates_of_its_generation(staged):
    bench = staged(settings=replace(STAGED, collect_every=1, collect_episodes=1), generations=3)
    lives = {}, {}
    while not bench.run.fleet.drain_background:
        bench.fetch()
        lives[0].update({job.generation: job for job in bench.given if job.kind == "collect"})
        bench.given = [job for job in bench.given if job.kind != "collect"]
        bench.finish()
    bench.restart()
    bench.fetch()
    lives[1].update({job.generation: job for job in bench.given if job.kind == "collect"})
    assert lives[0].items() <= lives[1].items()
    kept = [lives[1][number] for number in range(3)]
    assert [each.overrides for each in kept] == [(None, None, None)] * 2 + [(400, 0, None)]
    assert all(each.digest == each.spec(SPEC).digest("collect", each.vector, each.seeds) for each in kept)


def test_a_result_is_bounded_by_the_horizon_of_its_own_stage(staged):
    bench = staged(settings=replace(STAGED, stages=(StageSettings(1), StageSettings(horizon=2000))))
    while bench.run.generation.number == 0:
        bench.step()
    bench.fetch()
    job = bench.given[bench.first("score")]
    bench.answer(result(job.digest, steps=1500 * 1024))
    assert bench.run.generation.done == 1


def forked(bench, given=frozenset()):
    return Fork.of(bench.path.parent, bench.path.name, given).settings


def test_a_fork_begins_with_the_stage_that_its_run_is_in_and_goes_on_with_the_others_if_there_are_any(staged):
    ended = staged()
    ended.end()
    settings = forked(ended)
    assert (settings["stages"], settings["horizon"], settings["population"]) == ((), 600, 8)
    bench = staged(generations=4)
    bench.end()
    with RunFolder(bench.path) as run:
        assert run.stage_at(4).stage.number == 2
    settings = forked(bench)
    assert settings["stages"] == (StageSettings(score=500.0), *STAGES[2:])
    assert [settings[name] for name in ("horizon", "patience", "episodes", "racing")] == [400, 0, 2, True]
    assert settings["sigma0"] == bench.run.generations.sigma


@pytest.mark.parametrize("generations", [1, 5])
def test_a_run_among_several_searches_is_forked_only_with_a_schedule(staged, generations):
    ends = StageSettings(3, score=1e6)
    stages = (ends, replace(ends, restart=True), StageSettings(sigma0=0.05))
    bench = staged(generations=generations, settings=replace(STAGED, stages=stages))
    bench.end()
    with pytest.raises(UsageError, match="--schedule"):
        forked(bench)
    assert forked(bench, {"schedule"})


WHOLE = """
[[stage]]
generations = 60
steps = 3000000
score = 880.0
horizon = 400
patience = 60
episodes = 4
population = 32
sigma0 = 0.05
racing = false

[[stage]]
horizon = 1000
episodes = 16
racing = true
"""


@pytest.fixture
def read(tmp_path):
    def stages(text):
        path = tmp_path / "stages.toml"
        path.write_text(text)
        return find_schedule(str(path), {})

    return stages


@pytest.fixture
def settings(read, random_bundle):
    return lambda text, **flags: freeze(RunConfig(stages=read(text), **flags), random_bundle)


def test_the_first_stage_is_what_the_run_begins_as_also_where_it_is_configured_again(settings, random_bundle):
    found = settings(WHOLE, population=10, horizon=700, seed=5)
    assert (found.population, found.task.horizon, found.task.patience, found.sigma0) == (32, 400, 60, 0.05)
    assert found.stages == (StageSettings(60, 3_000_000, 880.0), StageSettings(horizon=1000, episodes=16, racing=True))
    assert [each.settings.task.horizon for each in stages_of(found)] == [400, 1000]
    assert comes_back(found, random_bundle)


def test_what_the_first_stage_does_not_name_is_as_the_flags_say(settings):
    found = settings("[[stage]]\nsteps = 5\n[[stage]]\nhorizon = 9\n", horizon=70, population=10)
    assert [(each.settings.task.horizon, each.settings.population) for each in stages_of(found)] == [(70, 10), (9, 10)]


def test_one_stage_without_an_end_is_a_run_without_a_schedule(settings, random_bundle):
    assert settings("[[stage]]\nhorizon = 70\n") == freeze(RunConfig(horizon=70), random_bundle)
    assert settings("[[stage]]\n") == freeze(RunConfig(), random_bundle)


NEXT = "\n[[stage]]\nhorizon = 50\n"


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("", r"\b0\b.*\b32\b"),
        ("stage = []", r"\b0\b"),
        ("[stage]\nhorizon = 3\n", r"\bstage\b"),
        ("[[stages]]\nhorizon = 3\n", "'stages'.*'stage'"),
        ("[run]\nhorizon = 3\n", r"\brun\b"),
        ("[[stage]]\nhorizont = 3\n", "'horizont' .*stage 1.*'horizon'"),
        ("[[stage]]\nseed = 3\n", "'seed' .*stage 1"),
        ("[[stage]]\nhorizon = 3.5\n", "horizon .*stage 1.*3.5"),
        ("[[stage]]\ngenerations = 0\n" + NEXT, "stage 1.*generations"),
        ("[[stage]]\ngenerations = 9\n[[stage]]\nsteps = -1\n" + NEXT, "stage 2.*steps"),
        ("[[stage]]\nscore = inf\n" + NEXT, "stage 1.*inf"),
        ("[[stage]]\n" * 33, r"\b33\b"),
        ("[[stage", "TOML|stages.toml"),
    ],
)
def test_what_no_schedule_can_be_is_one_line(read, text, names):
    with pytest.raises(UsageError, match=names):
        read(text)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("[[stage]]\nhorizon = 3\n" + NEXT, "1 .*2"),
        ("[[stage]]\ngenerations = 3\n[[stage]]\ngenerations = 3\n", "2 .*--generations"),
        ("[[stage]]\nrestart = true\nscore = 1.0\n" + NEXT, "1"),
        ("[[stage]]\ngenerations = 3\n[[stage]]\nrestart = true\nscore = 1.0\n" + NEXT, "2 .*1"),
        ("[[stage]]\nscore = 1.0\n[[stage]]\nrestart = true\n", "2"),
        (
            "[[stage]]\nscore = 1.0\n[[stage]]\nrestart = true\nsteps = 9\npopulation = 8\nsigma0 = 0.2\n" + NEXT,
            "2 .*1 .*population, sigma0",
        ),
        ("[[stage]]\ngenerations = 3\n", "1 .*--generations"),
        ("[[stage]]\ngenerations = 25\nscore = 1.0\n" + NEXT, "1 .*--evaluate-every"),
        ("[[stage]]\ngenerations = 2\nsteps = 128001\n" + NEXT, "1 .*128000"),
        ("[[stage]]\ngenerations = 2\nhorizon = 0\n" + NEXT, "1.*--horizon .*1000000"),
        ("[[stage]]\ngenerations = 2\n" + NEXT + "sigma0 = 0.0\n", "2.*--sigma0"),
        ("[[stage]]\ngenerations = 2\n" + NEXT + "racing = true\nepisodes = 1\n", "2.*--racing"),
        ("[[stage]]\ngenerations = 2\n" + NEXT + "population = 2\n", "2.*--population"),
    ],
)
def test_what_this_run_cannot_do_is_one_line(read, settings, text, names):
    assert read(text), "each stage by itself is well-formed"
    with pytest.raises(UsageError, match=f"(?<![0-9.]){names}"):
        settings(text)


def test_what_this_run_cannot_do_with_its_flags_names_the_stage(settings):
    with pytest.raises(UsageError, match=r"1 .*--evaluate-every"):
        settings("[[stage]]\nscore = 1.0\n" + NEXT, evaluate_every=0)
    with pytest.raises(UsageError, match=r"2.*--driven .*0\.1 .*4"):
        settings("[[stage]]\ngenerations = 3\n[[stage]]\ndriven = 0.1\nepisodes = 4\n", task="dream")


def args(file=None, given=()):
    return argparse.Namespace(sources={"file": file or {}}, given=frozenset(given))


def test_stages_may_stand_in_the_configuration_file_beside_other_tables(tmp_path):
    path = tmp_path / "fleet.toml"
    path.write_text("[run]\nhorizon = 500\n" + WHOLE + "\n[limits]\nminutes = 30\n")
    file = read_toml(path, TABLES, arrays=ARRAYS)
    assert [each.horizon for each in _with_stages(args(file), RunConfig()).stages] == [400, 1000]


def test_the_error_for_a_key_in_the_wrong_table_names_the_right_one():
    with pytest.raises(UsageError, match=r"'generations' .*\brun\b.*\blimits\b"):
        load_run_config(args({"run": {"generations": 3}}), {})
    with pytest.raises(UsageError, match=r"'population' .*\blimits\b.*\brun\b"):
        load_run_config(args({"limits": {"minutes": 3, "population": 8}}), {})


def test_a_schedule_of_its_own_is_stronger_than_the_configuration_file(tmp_path):
    path = tmp_path / "stages.toml"
    path.write_text("[[stage]]\nsteps = 5\n" + NEXT)
    file = {"stage": [{"steps": 9}, {"horizon": 3}]}
    assert _with_stages(args(file), RunConfig(schedule=str(path))).stages[0].steps == 5
    assert _with_stages(args(file), RunConfig()).stages[0].steps == 9
    assert _with_stages(args(file), RunConfig(schedule="none")).stages == ()


def test_a_flag_that_the_first_stage_names_too_is_refused():
    file = {"stage": [{"steps": 9, "horizon": 3}, {"horizon": 5}]}
    with pytest.raises(UsageError, match=r"--horizon .*horizon .*1"):
        _with_stages(args(file, {"horizon"}), RunConfig(horizon=7))
    assert _with_stages(args(file, {"patience"}), RunConfig(patience=7)).stages


def test_what_remains_of_a_schedule_begins_with_the_stage_and_its_end(settings, random_bundle):
    found = settings(WHOLE)
    first, last = stages_of(found)
    assert remaining_settings(found, first)["stages"] == found.stages
    assert remaining_settings(found, last) == {
        "horizon": 1000, "patience": 60, "episodes": 16, "population": 32, "sigma0": 0.05, "racing": True,
        "driven": 0.0, "stages": (),
    }  # fmt: skip
    freeze(RunConfig(**{**config_values(found, random_bundle.path), **remaining_settings(found, last)}), random_bundle)


def test_a_share_that_is_driven_stays_a_share_whatever_the_episodes(settings):
    text = "[[stage]]\ngenerations = 3\n[[stage]]\ndriven = 1\nepisodes = 4\nsteps = 9\n[[stage]]\nepisodes = 16\n"
    found = stages_of(settings(text, task="dream"))
    assert [each.driven_episodes for each in found] == [0, 4, 16]


@pytest.mark.parametrize(
    ("flags", "names"),
    [
        ({"driven": 0.5}, "--driven .*dream.*car-racing"),
        ({"task": "dream", "driven": 1.5}, "--driven .*1.5"),
        ({"task": "dream", "driven": float("nan")}, "--driven .*nan"),
        ({"task": "dream", "driven": 0.1, "episodes": 4}, "--driven .*0.1 .*4 .*--episodes"),
        ({"task": "dream", "driven": 0.5, "episodes": 4, "racing": True}, "--racing"),
    ],
)
def test_what_cannot_be_driven_is_said(flags, names):
    with pytest.raises(UsageError, match=names):
        RunConfig(**flags)
