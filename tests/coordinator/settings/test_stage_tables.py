"""A schedule as people write it: what it may say, and what is wrong with it in one line.

Tests run_setup.py and stage_tables.py.
"""

import argparse

import pytest

from dreamfleet.common.cli.config import read_toml
from dreamfleet.common.cli.global_config import ARRAYS, TABLES
from dreamfleet.common.errors import UsageError
from dreamfleet.common.runs.records import StageSettings
from dreamfleet.common.runs.stages import stages_of
from dreamfleet.coordinator.settings.config import RunConfig, config_values
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.settings.run_setup import _with_stages, load_run_config
from dreamfleet.coordinator.settings.stage_tables import find_schedule, remaining_settings
from tests.support.frozen_settings import comes_back

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
