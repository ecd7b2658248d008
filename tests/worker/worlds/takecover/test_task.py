"""Take Cover as a task and as an environment. Tests game.py and options.py."""

import json
import os
import sys

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import describe_task
from dreamfleet.common.runs.seeds import fold_seed
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.recordable import RecordableTask, TaskWithOptions, TaskWithPolicies
from dreamfleet.worker.tasks.registry import find_task, find_world
from dreamfleet.worker.worlds.takecover.game import LEFT, LIMIT, RIGHT, STAY, TakeCover
from dreamfleet.worker.worlds.takecover.options import TakeCoverOptions
from dreamfleet.worker.worlds.takecover.task import TakeCoverTask, cut_in_thirds, pick_choice
from tests.support.bundles import write_world_bundle
from tests.support.doom import games
from tests.support.world_contract import check_driver, check_world

ALL_CHANGED = '{"environment": {"actions": "thirds", "crop": "30:90,0:160", "tics": 1}}'


def spec(**arguments):
    description = describe_task("takecover", {"environment": arguments})
    shape = ControllerShape(description.observations, description.outputs)
    return TaskSpec("takecover", "", 525, 0, shape, options=description.options)


def pictures_of(tics, actions, seed=3):
    """The pictures after each action of a game, the sum of its rewards, and how it ended."""
    game = TakeCover(tics)
    pictures, total, ends = [game.reset(seed=seed)[0]], 0.0, (False, False)
    for action in actions:
        picture, reward, *ends, _ = game.step(action)
        pictures.append(picture)
        total += reward
        if any(ends):
            break
    game.close()
    return pictures, total, tuple(ends)


@pytest.mark.parametrize("options", ["", ALL_CHANGED])
def test_the_task_keeps_the_contract_of_recordable_worlds(doom, options):
    task = find_task("takecover").with_options(options)
    check_world(task)
    assert all(isinstance(task, each) for each in (RecordableTask, TaskWithOptions, TaskWithPolicies))


def test_a_world_follows_from_its_options():
    task = find_task("takecover")
    assert (task.world.horizon, task.world.frames_per_second, task.world.dream_reward.gain) == (525, 9, 4.0)
    assert (task.world.actions.outputs, *task.preprocessings) == (3, "box-64", "box-96")
    other = task.with_options(ALL_CHANGED)
    assert (other.world.horizon, other.world.frames_per_second, other.world.dream_reward.gain) == (2100, 35, 1.0)
    assert (other.world.actions.outputs, *other.preprocessings) == (
        1, "box-64 of 30:90,0:160", "box-96 of 30:90,0:160",
    )  # fmt: skip
    assert TakeCoverOptions(tics=8).horizon == 263  # of which the last is held for 4 tics


def test_options_are_frozen_where_they_differ_from_the_defaults():
    task = TakeCoverTask()
    assert task.parse_options({}) == task.parse_options({"environment": {"tics": 4, "actions": "choices"}}) == ""
    assert task.parse_options({"environment": {"tics": 1}}) == '{"environment": {"tics": 1}}'
    changed = TakeCoverOptions.parse(ALL_CHANGED)
    assert changed.text == ALL_CHANGED
    assert changed.part == (30, 90, 0, 160)


def test_flags_that_any_world_takes_are_options_too():
    arguments = {"environment": {"actions": "thirds"}, "skip": 1, "crop": "30:90,0:160"}
    assert TakeCoverTask().parse_options(arguments) == ALL_CHANGED


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ("[]", "takecover"),
        ("{", "takecover"),
        ('{"variant": 1}', "variant"),
        ('{"environment": {"skill": 5}}', "skill.* tics, actions, crop"),
        ('{"environment": 3}', "3"),
        ('{"environment": {"tics": 0}}', "tics.* 1 .*10"),
        ('{"environment": {"tics": true}}', "tics"),
        ('{"environment": {"tics": 3}, "skip": 4}', "--skip 4 .*--environment tics=3"),
        ('{"environment": {"actions": "five"}}', "five"),
        ('{"environment": {"crop": "0:121,0:160"}}', "0:121,0:160"),
        ('{"environment": {"crop": "9:9,0:160"}}', "9:9,0:160"),
        ('{"environment": {"crop": [0, 100]}}', "0, 100"),
    ],
)
def test_other_options_are_refused(options, named):
    with pytest.raises(UsageError, match=named):
        TakeCoverTask().with_options(options)


def test_an_action_is_one_of_three():
    assert [pick_choice(row) for row in np.eye(3, dtype=np.float32)] == [STAY, LEFT, RIGHT]
    numbers = np.array([[-1], [-0.34], [-0.33], [0], [0.33], [0.34], [1]], np.float32)
    assert [cut_in_thirds(number) for number in numbers] == [LEFT, LEFT, STAY, STAY, STAY, RIGHT, RIGHT]


def test_drivers_follow_the_actions():
    task = find_task("takecover").with_options(ALL_CHANGED)
    check_driver(task, "held")
    policy = task.policies["uniform"](np.random.default_rng(1))
    assert len({float(policy.act(None)[0]) for _ in range(20)}) == 20


def test_the_environment_is_one_of_gymnasiums(doom):
    game = TakeCover()
    with pytest.warns(UserWarning, match="spec"):  # it is not registered
        check_env(game)
    game.close()


def test_an_action_held_for_four_tics_is_four_actions(doom):
    actions = [STAY, LEFT, RIGHT, RIGHT, STAY, LEFT] * 100
    held, score, ends = pictures_of(4, actions)
    each, same_score, same_ends = pictures_of(1, np.repeat(actions, 4))
    assert (score, ends) == (same_score, same_ends)
    assert ends == (True, False)  # a death
    assert score == len(each) - 1
    assert all((one == other).all() for one, other in zip(held[:-1], each[::4], strict=False))


def test_the_black_picture_of_a_death_is_never_seen(doom):
    pictures, _, ends = pictures_of(4, [STAY] * 600)
    assert ends == (True, False)
    assert all(picture.any() for picture in pictures)
    assert (pictures[-1] == pictures[-2]).all()


def test_the_limit_of_tics_is_no_death(fake_doom):
    pictures, score, ends = pictures_of(8, [RIGHT] * 600)  # the stand-in lives on
    assert (len(pictures) - 1, score, ends) == (263, float(LIMIT), (False, True))


def test_a_long_seed_is_folded_and_a_reset_without_one_goes_on(doom):
    game, long = TakeCover(), 2**53 - 1
    after = {}
    for seed in (long, fold_seed(long), long - 1):
        game.reset(seed=seed)
        after[seed] = [game.step(RIGHT)[0].tobytes() for _ in range(120)]
    assert after[long] == after[fold_seed(long)] != after[long - 1]
    games_without = []
    for _ in range(2):
        game.reset(seed=1)
        for _ in range(2):
            game.reset()
            games_without.append(b"".join(game.step(RIGHT)[0].tobytes() for _ in range(120)))
    assert games_without[:2] == games_without[2:]
    assert games_without[0] != games_without[1]
    game.close()


def test_a_run_without_a_world_model_sees_a_band_of_pixels(doom):
    description = describe_task("takecover", {"environment": {"tics": 1}})
    assert (description.observations, description.outputs, description.packages) == (
        128, 3, ("numpy", "onnxruntime", "vizdoom"),
    )  # fmt: skip
    assert json.loads(description.options) == {"environment": {"tics": 1}}
    scorer = Scorer(spec(tics=2))
    parameters = np.random.default_rng(1).normal(size=387).astype(np.float32)
    score = scorer.score("score", parameters, 2**40)
    assert score == scorer.score("score", parameters, 2**40)
    assert 0 < score.fitness <= 2 * score.steps < score.fitness + 2
    assert scorer.drawn_by == "vizdoom"
    scorer.close()


def test_whoever_watches_gets_the_games_picture(fake_doom):
    environment = TakeCoverTask().make_watched_environment(Assignment(spec()))
    observation, _ = environment.reset(seed=1)
    assert (observation.shape, environment.render().shape) == ((128,), (120, 160, 3))
    environment.close()


@pytest.mark.parametrize("options", ["", ALL_CHANGED])
def test_a_world_model_brings_its_options(doom, tmp_path, options):
    world = find_world("takecover", options)
    facts = world.world.facts(RewardFacts("survival", world.world.dream_reward.gain), EndRule("drawn"), options)
    bundle = write_world_bundle(
        tmp_path / "takecover.zip", facts, "takecover", preprocessing=next(iter(world.preprocessings))
    )
    assert (facts.score_word, facts.marks, facts.horizon) == ("game", (750.0,), world.world.horizon)
    scorer = Scorer(TaskSpec("takecover", bundle.sha256, horizon=5, patience=0), bundle)
    parameters = np.random.default_rng(1).normal(size=bundle.controller_shape.size).astype(np.float32)
    score = scorer.score("score", parameters, 2**40)
    assert (score.steps, score.fitness) == (5, 5 * facts.reward.gain)
    assert score == scorer.score("score", parameters, 2**40)
    scorer.close()


def test_a_mirrored_picture_shows_the_other_way():
    choices, thirds = (find_world("takecover", options).world.mirror for options in ("", ALL_CHANGED))
    stay, left, right = np.eye(3, dtype=np.float32)
    assert [(choices.apply(each) == other).all() for each, other in ((stay, stay), (left, right), (right, left))]
    assert thirds.apply(np.float32([0.5])) == -0.5


def test_a_bundle_of_another_world_is_refused(fake_doom, random_bundle):
    assignment = Assignment.of("takecover", random_bundle)
    with pytest.raises(BundleError, match=r"'car-racing'.*takecover .*'box-64'"):
        TakeCoverTask().make_environment(assignment)


def test_without_the_package_the_task_is_known_and_an_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "vizdoom", None)
    assert find_task("takecover").world.threshold == 750
    with pytest.raises(UsageError, match=r"'dreamfleet\[doom\]'"):
        Scorer(spec())


def test_an_environment_that_nobody_resets_starts_no_game(doom):
    environment = TakeCoverTask().make_recorded("box-64")
    assert games(os.getpid()) == set()
    environment.close()


@pytest.mark.add_on
def test_the_list_of_tasks_names_the_missing_package(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "vizdoom", None)
    assert main(["tasks", "--json"]) == 0
    found = {row["task"]: row["here"] for row in json.loads(capsys.readouterr().out)}
    assert "'dreamfleet[doom]'" in found["takecover"]
