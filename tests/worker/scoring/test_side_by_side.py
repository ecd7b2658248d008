"""Episodes that a slot drives side by side have the bits that they have alone. Tests drive_count.py and
worker/tasks/side_by_side.py."""

import dataclasses

import numpy as np
import pytest

from dreamfleet import Scorer, TaskSpec, find_bundle, find_controller
from dreamfleet.common.artifacts.car_racing_variants import Variant
from dreamfleet.worker.scoring.drive_count import ENOUGH, MEASURE_AGAIN, DriveCount
from dreamfleet.worker.worldmodel.mdnrnn_config import REWARDED
from dreamfleet.worker.worlds.car_racing.task import CarRacingTask
from tests.support.bundles import write_random_bundle
from tests.support.variants import VARIANTS, vectors
from tests.support.watching import Watching

SEEDS = range(2**20, 2**20 + 4)


@pytest.fixture
def tiny():
    return find_bundle("tiny-int8")


def spec(bundle, **changes):
    return dataclasses.replace(TaskSpec("car-racing", bundle.sha256, horizon=60, patience=30), **changes)


def jobs(bundle):
    return [("score", each, seed) for each, seed in zip(vectors(bundle, len(SEEDS)), SEEDS, strict=True)]


def assert_equal_bits(bundle, asked):
    with_others, alone = Scorer(asked, bundle), Scorer(asked, bundle)
    found, steps = jobs(bundle), []
    together = with_others.score_all(found, steps.append)
    assert together == [alone.score(*each) for each in found]
    assert len({score.fitness for score in together}) == len(found)
    assert steps[-1] == sum(score.steps for score in together)
    assert with_others.score_all(found[::-1], steps.append) == together[::-1]
    assert with_others.score_all(found[1:3], steps.append) == together[1:3]


@pytest.mark.parametrize("name", ["tiny-int8", "tiny", "rewarded"])
def test_a_score_has_the_same_bits_alone_and_side_by_side(tmp_path, name):
    if name == "rewarded":
        bundle = write_random_bundle(tmp_path / "b.zip", rnn=dataclasses.replace(REWARDED, previous_reward=True))
    else:
        bundle = find_bundle(name)
    assert_equal_bits(bundle, spec(bundle, horizon=120))


@pytest.mark.parametrize("name", [*VARIANTS, "prices"])
def test_a_variant_has_the_same_bits_alone_and_side_by_side(random_bundle, name):
    variant = VARIANTS.get(name, Variant(offroad_cost=0.5, time_cost=0.2))
    bundle = random_bundle.with_controllers(None, variant)
    assert_equal_bits(bundle, spec(bundle, options=variant.options, version=variant.version))


def test_every_episode_has_an_end_of_its_own_and_parameters_that_are_no_numbers_are_refused(tiny):
    scorer, able = Scorer(spec(tiny, horizon=200), tiny), find_controller("tiny").parameters
    still, wrong = np.zeros_like(able), np.full_like(able, np.nan)
    episodes = [("score", each, 2**20) for each in (still, able, still, able)]
    scores = scorer.score_all(episodes, lambda _: None)
    assert scores[0].steps < scores[1].steps == 200
    assert scores[:2] == scores[2:]
    assert scores == [scorer.score(*each) for each in episodes]
    with pytest.raises(ValueError):
        scorer.score_all([*episodes[:3], ("score", wrong, 1)], lambda _: None)


def test_a_watched_or_measured_group_is_driven_one_by_one(tiny):
    scorer = Scorer(spec(tiny, horizon=10, patience=0), tiny)
    unwatched = scorer.score_all(jobs(tiny), lambda _: None)
    scorer.observer = Watching()
    assert scorer.score_all(jobs(tiny), lambda _: None) == unwatched
    assert [(number, seen.step) for number, seen in scorer.observer] == [
        (n, step) for n in range(4) for step in range(10)
    ]
    measuring = Scorer(spec(tiny, measures=("gas",)), tiny)
    assert measuring.side_by_side == 1
    assert all(score.measures for score in measuring.score_all(jobs(tiny)[:2], lambda _: None))


def test_the_drives_of_a_dreams_run_are_driven_side_by_side(tiny):
    asked = TaskSpec("dream", tiny.sha256, horizon=60, patience=30, temperature=1.0)
    scorer, real, driven = Scorer(asked, tiny), Scorer(spec(tiny), tiny), asked.with_overrides(driven=True)
    assert scorer.side_by_side == CarRacingTask.batch_size
    together = scorer.score_all(jobs(tiny), lambda _: None, driven)
    assert together == [scorer.score(*each, spec=driven) for each in jobs(tiny)]
    assert together == real.score_all(jobs(tiny), lambda _: None)


def counting(most):
    count = DriveCount()
    count.most = most
    return count


def drive(count, costs, groups, waiting=99):
    """The numbers that are asked for by groups that take as long as `costs`: seconds a step by number of drives."""
    asked = []
    for _ in range(groups):
        asked.append(drives := count.choose(waiting))
        count.add(drives, 1000 * drives, 1000 * drives * costs[drives])
    return asked


@pytest.mark.parametrize(
    ("costs", "best"),
    [({4: 3, 2: 4, 1: 5}, 4), ({4: 5, 2: 3, 1: 4}, 2), ({4: 5, 2: 5, 1: 4}, 1), ({6: 1, 4: 2, 2: 3, 1: 4}, 6)],
)
def test_the_number_whose_steps_take_least_time_is_found_and_kept(costs, best):
    count = counting(max(costs))
    assert drive(count, costs, len(costs) * ENOUGH) == [number for number in costs for _ in range(ENOUGH)]
    assert drive(count, costs, MEASURE_AGAIN // 2) == [best] * (MEASURE_AGAIN // 2)


def test_a_host_that_changes_is_measured_again():
    count = counting(4)
    drive(count, {4: 3, 2: 4, 1: 5}, 3 * ENOUGH)
    asked = drive(count, {4: 6, 2: 4, 1: 5}, 8 * MEASURE_AGAIN)
    assert count.best == 2
    assert asked.count(1) < len(asked) / 20


def test_what_is_not_compared_changes_nothing():
    count = counting(2)
    for _ in range(ENOUGH):
        count.add(2, 0, 100.0)  # episodes that are over at once
        count.add(3, 1000, 0.1)  # more than a slot can do
    assert (count.choose(99), count.best) == (1, 2)
    count = DriveCount()  # of a slot that drives one by one
    assert drive(count, {1: 3}, 100) == [1] * 100
    assert count.best == count.most == 1


@pytest.mark.parametrize(
    ("waiting", "costs", "asked"),
    [(3, {3: 2, 2: 1, 1: 3}, [3, 2, 1, 2]), (2, {2: 2, 1: 1}, [2, 1, 1, 1]), (0, {1: 1}, [1] * 4)],
)
def test_with_few_jobs_a_slot_it_is_found_among_the_numbers_that_can_be(waiting, costs, asked):
    count = counting(4)
    assert drive(count, costs, 4 * ENOUGH, waiting)[::ENOUGH] == asked
    assert drive(count, {4: 1, **costs}, ENOUGH) == [4] * ENOUGH
