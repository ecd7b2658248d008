"""Dreams begun before real losses of the road, judged by probes on the dream.
Tests dream_comparisons.py, disturbed_rollouts.py, probe.py and subject.py."""

from dataclasses import replace
from functools import partial
from itertools import islice

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import write_bundle
from dreamfleet.common.artifacts.car_racing_variants import Variant
from dreamfleet.common.errors import ControllerError, UsageError
from dreamfleet.worker.addons.inspection import dream_comparisons, probe
from dreamfleet.worker.addons.inspection.disturbed_rollouts import (
    OFF,
    DisturbedDriveConfig,
    DreamSegment,
    DriveDreamer,
    first_sustained,
    record_disturbed_drives,
)
from dreamfleet.worker.addons.inspection.dream_comparisons import (
    CALM,
    RoadLossConfig,
    RoadOutcome,
    RoadProbe,
    collect_losing_drives,
    compare_losses,
)
from dreamfleet.worker.addons.inspection.probe import (
    Estimate,
    LinearProbe,
    NetworkProbe,
    cross_validate_probes,
    explained_variance,
    folds,
)
from dreamfleet.worker.addons.inspection.subject import DriverChoice, make_controller_actor, make_driver_actors
from dreamfleet.worker.scoring.actors import ControllerActor
from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.training.data.collect_config import known_drivers
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.tasks import TOY
from tests.support.variants import controller_of

CONFIG, DRIVEN = RoadLossConfig(losses=6, before=(20, 0), dreams=2), DisturbedDriveConfig(opening=50)


@pytest.fixture(scope="module")
def drives(tiny, controller):
    recurrent = RecurrentState(tiny)
    actor = ControllerActor(controller, tiny, recurrent)
    return collect_losing_drives(record_disturbed_drives(tiny, recurrent, lambda _seed: actor, DRIVEN), CONFIG, DRIVEN)


@pytest.mark.slow
def test_as_many_losses_are_gathered_as_are_wanted_and_too_few_are_reported(drives):
    lost = [each for each in drives if each.lost is not None]
    assert len(lost) >= CONFIG.losses
    assert drives[-1].lost is not None
    for each in lost:
        assert each.truth[OFF][each.lost : each.lost + DRIVEN.lasting].all()
    calm = [replace(each, lost=None) for each in drives]
    with pytest.raises(UsageError, match="--noise"):
        collect_losing_drives(iter(calm), CONFIG, DRIVEN)
    blind = [replace(each, truth={"speed": each.truth["speed"]}) for each in drives]
    with pytest.raises(UsageError, match=r"lateral_offset.*off_road"):
        collect_losing_drives(iter(blind), CONFIG, DRIVEN)


@pytest.mark.slow
def test_reality_loses_the_road_and_the_probe_sees_it_and_nothing_where_all_is_calm(drives, tiny, controller):
    report = compare_losses(drives, tiny, controller, CONFIG, DRIVEN)
    compared = {each.begun: each for each in report.begun}
    assert list(compared) == ["20 steps before", "0 steps before", CALM]
    for begun in ("20 steps before", "0 steps before"):
        lost = compared[begun].figures["lost"]
        assert compared[begun].count == CONFIG.losses
        assert lost["reality"].value == 1
        assert lost["foreseen"].value >= 0.75
        assert 0 <= lost["dream"].value <= 1
    assert compared[CALM].figures["lost"]["reality"].value == 0
    assert compared[CALM].figures["lost"]["foreseen"].value <= 0.25
    assert len(report.table()[0]) == 3 * 4


def test_a_dream_begins_at_its_real_step_and_is_a_function_of_seed_and_step(drives, tiny, controller):
    dreamer, begun = DriveDreamer(tiny, controller, 1.0, 3), DreamSegment(drives[0], 120, 15)
    features, rewards = dreamer.dream(begun, own=True)
    assert (features.shape, rewards.shape) == ((3, 15, 288), (3, 15))
    assert (features[:, 0] == drives[0].features[120]).all()
    assert not np.array_equal(features[0, 1:], features[1, 1:])
    assert np.array_equal(features, dreamer.dream(begun, own=True)[0])
    calm = replace(drives[0], push=np.zeros_like(drives[0].push))
    for other in (DreamSegment(drives[0], 121, 15), DreamSegment(calm, 120, 15)):  # it is pushed as reality was
        assert not np.array_equal(features, dreamer.dream(other, own=True)[0])


def test_in_a_dream_of_the_same_actions_nobody_chooses(drives, tiny, controller):
    other, begun = replace(controller, parameters=-controller.parameters), DreamSegment(drives[0], 120, 15)
    one, another = (DriveDreamer(tiny, each, 1.0, 2) for each in (controller, other))
    for own in (False, True):
        assert np.array_equal(one.dream(begun, own=own)[0], another.dream(begun, own=own)[0]) == (not own)


def test_what_is_foreseen_has_the_memory_of_reality(drives, tiny, controller):
    features, rewards = DriveDreamer(tiny, controller, 1.0, 1).predict_next(drives[0])
    assert (features.shape, rewards.shape) == (drives[0].features.shape, drives[0].reward.shape)
    assert np.array_equal(features[:, 32:], drives[0].features[:, 32:])
    assert np.array_equal(features[0], drives[0].features[0])
    near = [np.corrcoef(features[50:, row], drives[0].features[50:, row])[0, 1] for row in range(32)]
    assert max(near) > 0.8


def test_a_probe_estimates_off_the_road_from_features(drives, tiny, controller):
    dreamer = DriveDreamer(tiny, controller, 1.0, 1)
    foreseen = [dreamer.predict_next(each)[0] for each in drives]
    road_probe = RoadProbe(drives[:-1], foreseen[:-1], DRIVEN.opening)
    outcome = road_probe.outcome(foreseen[-1][None, 50:], drives[-1].reward[None, 50:])
    off = drives[-1].truth[OFF][50:] > 0
    assert outcome.off[0][off].mean() > 0.5
    assert outcome.off[0][~off].mean() < 0.1
    assert outcome.offset[0][off].mean() > outcome.offset[0][~off].mean() + 3


def test_an_outcome_is_summarised_over_dreams():
    off = np.zeros((2, 20), bool)
    off[0, 5:10] = True
    off[1, 17:] = True
    found = RoadOutcome(off, np.where(off, 8.0, 2.0), np.full((2, 20), 0.5)).summarise(lasting=4)
    assert found == {"lost": 0.5, "off_at_end": 3 / 8, "offset_at_end": 2 + 6 * 3 / 8, "reward": 10}


def test_a_world_model_knows_yaw_from_what_it_remembers_not_from_a_picture(drives, monkeypatch):
    monkeypatch.setattr(probe, "UPDATES", 30)  # the network's, which is not looked at
    knowledge = cross_validate_probes(drives, DRIVEN.opening)
    known = {each.quantity: each.found for each in knowledge.known}
    assert OFF not in known
    assert known["yaw_rate"]["zh_linear"].value > 0.8 > known["yaw_rate"]["z_linear"].value + 0.2
    assert known["lateral_offset"]["z_linear"].value > 0.5
    assert [row["quantity"] for row in knowledge.table()[0]] == list(known)


@pytest.mark.slow
def test_a_dream_is_held_to_what_is_rare_in_reality(drives, tiny, controller, monkeypatch):
    report = dream_comparisons.compare_frequencies(drives, tiny, controller, DRIVEN.opening, 2, 1.0)
    found = {each.quantity: each for each in report.quantities}
    assert OFF not in found
    for each in found.values():
        assert each.found["reality"].value == pytest.approx(0.1, abs=0.05)  # over drives of unequal lengths
        assert 0 <= each.found["dream"].value <= 1
    assert found["yaw_rate"].found["foreseen"].value == pytest.approx(0.1, abs=0.05)
    assert found["speed"].rare > 20
    with pytest.raises(UsageError, match="100"):
        dream_comparisons.compare_frequencies(drives[:1], tiny, controller, DRIVEN.opening, 2, 1.0)
    monkeypatch.setattr(dream_comparisons, "_before_ends", lambda features: features[0, :0])
    with pytest.raises(UsageError):  # all dreams end as they begin
        dream_comparisons.compare_frequencies(drives, tiny, controller, DRIVEN.opening, 2, 1.0)


def test_steps_behind_a_dreams_end_do_not_count():
    features = np.arange(24.0).reshape(2, 4, 3)
    features[1, 2:] = features[1, 1]
    assert dream_comparisons._before_ends(features).tolist() == [*features[0, 1:].tolist(), features[1, 1].tolist()]


def test_one_drive_is_too_few_to_fit_and_judge(drives):
    for few, opening in ((drives[:1], DRIVEN.opening), ([], DRIVEN.opening), (drives, max(map(len, drives)))):
        with pytest.raises(UsageError):
            cross_validate_probes(few, opening)


def test_a_drive_that_ended_in_the_opening_is_no_drive_to_judge(drives, monkeypatch):
    monkeypatch.setattr(probe, "UPDATES", 30)
    truth = {name: column[:20] for name, column in drives[0].truth.items()}
    short = replace(drives[0], truth=truth, action=drives[0].action[:20])
    one, other = (cross_validate_probes(each, DRIVEN.opening) for each in ([short, *drives[:2], short], drives[:2]))
    assert one.known == other.known
    assert (one.drives, one.steps) == (other.drives, other.steps)


VARIANT = Variant(pedals="one", pedal_shift=0.25, decide_every=3, feedback="last")


def witnessed(observing_model, own, noise):
    """A drive of eleven steps by a controller of `own`, observed by `watching`."""
    driving = DriverChoice(controller_of(own.with_controllers(None, VARIANT)), own)
    recurrent = RecurrentState(driving.observing_model(observing_model))
    drives = record_disturbed_drives(
        observing_model, recurrent, driving.actors(observing_model, recurrent), DisturbedDriveConfig(noise, steps=11)
    )
    drive = next(drives)
    drives.close()
    return drive, driving.controller


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_a_choice_is_held_whatever_is_pushed_meanwhile(random_bundle, noise):
    drive, _ = witnessed(random_bundle, random_bundle, noise)
    assert drive.state[:, -1].tolist() == [0, 1, 2] * 3 + [0, 1]
    choices = drive.state[:, -7:-4]
    for begun in (1, 4, 7):
        assert (choices[begun : begun + 3] == choices[begun]).all()
    calm = np.array_equal(drive.action[:9].reshape(3, 3, 3)[:, 0], choices[[1, 4, 7]])
    assert calm == (noise == 0)


def test_a_dream_that_begins_between_two_choices_holds_on_to_the_one_before(random_bundle):
    drive, controller = witnessed(random_bundle, random_bundle, 0.0)
    dreamer, begun = DriveDreamer(random_bundle, controller, 1.0, 2), DreamSegment(drive, 4, 6)
    own, same = (dreamer.dream(begun, own=each)[0] for each in (True, False))
    assert np.array_equal(own[:, :3], same[:, :3]), "steps 4 and 5 do what step 3 chose"
    assert not np.array_equal(own[:, 4:], same[:, 4:])


@pytest.fixture
def features():
    return np.random.default_rng(0).normal(size=(3000, 6)) * [1, 2, 0.1, 5, 1, 0] + 3  # the last one says nothing


def test_a_linear_probe_finds_what_is_linear(features):
    targets = np.stack([features[:, 0] - 20 * features[:, 2], 100 + features[:, 3]], axis=1)
    probe = LinearProbe.fit(features[:2000], targets[:2000])
    np.testing.assert_allclose(probe.predict(features[2000:]), targets[2000:], atol=0.02 * targets.std())


def test_weights_say_which_samples_count(features):
    targets = np.where(np.arange(3000) < 2900, 0.0, 1.0)[:, None]
    weights = np.where(targets[:, 0] > 0, 1 / 100, 1 / 2900)
    assert LinearProbe.fit(features, targets).predict(features).mean() == pytest.approx(1 / 30)
    assert LinearProbe.fit(features, targets, weights).predict(features).mean() == pytest.approx(0.5, abs=0.05)


def test_a_network_finds_what_no_line_does_and_the_same_each_time(features):
    targets = np.abs(features[:, :1] - 3)
    linear, layered = (kind.fit(features[:2000], targets[:2000]) for kind in (LinearProbe, NetworkProbe))
    predicted = layered.predict(features[2000:])
    assert explained_variance([targets[2000:]], [linear.predict(features[2000:])])[0].value < 0.1
    assert explained_variance([targets[2000:]], [predicted])[0].value > 0.9
    assert np.array_equal(predicted, NetworkProbe.fit(features[:2000], targets[:2000]).predict(features[2000:]))


@pytest.mark.parametrize("drives", [2, 3, 4, 9])
def test_every_drive_is_judged_once_by_what_was_fitted_without_it(drives):
    parts = list(folds(drives))
    assert sorted(row for part, _ in parts for row in part) == list(range(drives))
    for part, rest in parts:
        assert rest
        assert sorted([*part, *rest]) == list(range(drives))


def test_r_squared_is_one_for_the_truth_and_zero_for_the_mean():
    random = np.random.default_rng(1)
    truths = [random.normal(size=(50, 2)) for _ in range(8)]
    mean = np.concatenate(truths).mean(axis=0)
    assert explained_variance(truths, truths) == [Estimate(1.0, 0.0)] * 2
    for share in explained_variance(truths, [np.tile(mean, (50, 1))] * 8):
        assert share.value == pytest.approx(0)
    noisy = [each + random.normal(size=each.shape) * 0.5 for each in truths]
    for share in explained_variance(truths, noisy):
        assert share.value == pytest.approx(0.75, abs=0.06)
        assert 0 < share.error < 0.05


def test_of_what_never_changes_nothing_is_explained():
    straight = [np.stack([np.zeros(20), np.arange(20.0)], axis=1) for _ in range(3)]
    assert explained_variance(straight, [each + 0.1 for each in straight])[0] == Estimate(0, 0)


def test_an_estimate_is_a_mean_and_its_standard_error():
    assert Estimate.of([1, 2, 3, 4]) == Estimate(2.5, pytest.approx(0.6455, abs=1e-4))
    assert str(Estimate(0.5, 0.049)) == "0.50 ± 0.05"


SMALL, RNN = VAEConfig(latent=5, channels=(4, 4, 4, 8)), MDNRNNConfig(latent=5, hidden=8)


def disturbed(bundle, actors, **config):
    recurrent = RecurrentState(bundle)
    config = DisturbedDriveConfig(**config)
    return record_disturbed_drives(bundle, recurrent, lambda seed: actors(recurrent, seed), config)


def drive(bundle, actors, **config):
    return next(disturbed(bundle, actors, **config))


def drivers(name, bundle):
    actors = make_driver_actors(bundle, name)
    return lambda _recurrent, seed: actors(seed)


def test_without_noise_a_controller_drives_as_its_policy_does(tiny, controller):
    task, assignment = find_task("car-racing"), Assignment.of("car-racing", tiny)
    policy, environment = task.make_policy(assignment), task.make_environment(assignment)
    policy.begin(controller.parameters)
    moments = list(run_episode(environment, policy, EpisodeConfig(20_002, 60)))
    environment.close()

    def actor(recurrent, _seed):
        return ControllerActor(controller, tiny, recurrent)

    seen = drive(tiny, actor, noise=0, steps=60, first_seed=20_002)
    np.testing.assert_allclose(seen.action, [each.action for each in moments], atol=1e-5)
    assert seen.reward.tolist() == [each.reward for each in moments]
    assert seen.features.shape == (60, 32 + 256)
    np.testing.assert_allclose(seen.latent[-1], policy.latent[0], atol=1e-5)
    assert (seen.state[0] == 0).all()


def test_a_drive_ends_behind_its_loss_and_is_a_function_of_its_seed(tiny):
    one, other = (drive(tiny, drivers("held", tiny), noise=1.0, after=30) for _ in range(2))
    assert one.lost is not None
    assert len(one) == one.lost + 30
    assert one.truth[OFF][one.lost - 1] == 0
    assert (one.truth[OFF][one.lost : one.lost + 10] == 1).all()
    assert np.array_equal(one.state, other.state)
    assert np.array_equal(one.action, other.action)


def test_a_controller_of_another_world_model_drives_by_its_own(tiny, controller, tmp_path):
    def watched_by(bundle, recurrent, _seed):
        return make_controller_actor(controller, tiny, bundle, recurrent)

    watching = write_random_bundle(tmp_path / "small.zip", vae=SMALL, rnn=RNN)
    watched, driven = (drive(each, partial(watched_by, each), noise=0.1, steps=30) for each in (watching, tiny))
    assert watched.features.shape == (30, 13)
    assert np.array_equal(watched.action, driven.action)
    whole = replace(SMALL, picture=96, padding="same")
    other = write_random_bundle(tmp_path / "whole.zip", vae=whole, rnn=RNN)
    with pytest.raises(ControllerError, match=r"box-64.*car-racing.*raw-96"):
        make_controller_actor(controller, tiny, other, RecurrentState(other))


def test_all_drivers_of_data_sets_drive_for_a_probe_and_no_others(tiny):
    for name in ("random", *known_drivers()):
        assert drive(tiny, drivers(name, tiny), steps=3).action.shape == (3, 3)
    with pytest.raises(UsageError, match="'ghost'"):
        make_driver_actors(tiny, "ghost")


@pytest.mark.parametrize(
    ("off", "first"), [("0111010", 1), ("0110110", -1), ("1110111", 0), ("0000111", 4), ("0000000", -1), ("11", -1)]
)
def test_a_road_is_lost_where_the_car_is_off_it_for_long_enough(off, first):
    assert first_sustained(np.array([[each == "1" for each in off]]), 3).tolist() == [first]


def test_tracks_follow_each_other(tiny):
    one, other = islice(disturbed(tiny, drivers("held", tiny), steps=3, first_seed=20_007), 2)
    assert (one.seed, other.seed) == (20_007, 20_008)
    assert not np.array_equal(one.latent, other.latent)


def test_a_driver_that_never_comes_far_begins_anywhere(tiny):
    start, one, other = (
        drive(tiny, drivers("held", tiny), steps=2, first_seed=20_000, anywhere=each).truth["lateral_offset"][0]
        for each in (False, True, True)
    )
    assert abs(start) < 0.01 < abs(one)
    assert one == other


def test_a_world_without_true_state_is_reported(tmp_path):
    ours = write_random_bundle(tmp_path / "ours.zip", vae=SMALL, rnn=RNN)
    parts = {name: ours.read(name) for name in ours.manifest.parts}
    toy = write_bundle(tmp_path / "toy.zip", replace(ours.manifest, task=TOY), parts)
    with pytest.raises(UsageError):
        drive(toy, drivers)
