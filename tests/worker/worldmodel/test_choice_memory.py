"""A variant's controllers follow their formula, repeat choices as configured, and give the same bits in any batch.
Tests policy.py and common/artifacts/world_driving.py."""

from itertools import pairwise

import numpy as np
import pytest

from dreamfleet.common.artifacts.car_racing_variants import Variant
from dreamfleet.common.artifacts.controller import act
from dreamfleet.worker.worldmodel.inference import Controllers, DreamStep, Encoder, PolicyStep
from tests.support.variants import VARIANTS, vectors

ROWS = 256


@pytest.fixture(scope="module", params=[*VARIANTS, "plain"])
def varied(request, random_bundle):
    return random_bundle.with_controllers(None, VARIANTS.get(request.param, Variant()))


def feed(step, rows, seed=0):
    """A batch in the middle of dreams whose rows have repeated their choices for different times."""
    random = np.random.default_rng(seed)
    state = random.normal(0, 0.5, (rows, step.state_size)).astype(np.float32)
    state[:, -1] = random.integers(0, 2, rows)
    latent, normal = random.normal(size=(2, rows, step.latent_size)).astype(np.float32)
    return {"latent": latent, "state": state, "normal": normal, "uniform": random.random((rows, 32), np.float32)}


@pytest.mark.parametrize("hidden", [0, 5])
def test_a_dreamers_bits_do_not_depend_on_who_else_dreams(random_bundle, varied, hidden):
    bundle = random_bundle.with_controllers(random_bundle.shape_of("zh", hidden, varied.variant), varied.variant)
    step, order = DreamStep(bundle), np.random.default_rng(3).permutation(ROWS)
    given = {**feed(step, ROWS), "parameters": vectors(bundle, ROWS)}
    whole = step.step(**given, temperature=1.15)
    for rows in (1, 2, 7, 256):
        for start in range(0, ROWS - rows + 1, max(rows, 32)):
            chosen = order[start : start + rows]
            few = step.step(**{name: each[chosen] for name, each in given.items()}, temperature=1.15)
            assert all(np.array_equal(one, other[chosen]) for one, other in zip(few, whole, strict=True))


@pytest.mark.parametrize("features", ["z", "zh"])
@pytest.mark.parametrize("hidden", [0, 5])
def test_a_controller_acts_by_its_formula_in_the_dream_and_in_reality(random_bundle, varied, features, hidden):
    variant = varied.variant
    bundle = random_bundle.with_controllers(random_bundle.shape_of(features, hidden, variant), variant)
    policy, dream, parameters = PolicyStep(bundle), DreamStep(bundle), vectors(bundle, 4)
    given = feed(dream, 4)
    given["state"][:, -1] = 0  # all decide anew, or it is a column like any other
    real = policy.step(
        np.random.default_rng(2).integers(0, 256, (4, 64, 64, 3), dtype=np.uint8), parameters, given["state"]
    )
    dreamt = dream.step(**{**given, "latent": real.latent}, parameters=parameters, temperature=1.0)
    assert np.array_equal(dreamt.action, real.action)
    np.testing.assert_allclose(dreamt.state, real.state, atol=1e-5)
    assert dreamt.action.shape == (4, 3)
    seen = [real.latent, given["state"][:, :256]] if features == "zh" else [real.latent]
    if variant.feedback == "last":
        last, before = given["state"][:, -7:-4], given["state"][:, -4:-1]
        outputs = [variant.controls.to_outputs(each) for each in (last, before)]
        seen += [outputs[0], outputs[0] - outputs[1]]
    for row, value in enumerate(np.concatenate(seen, axis=1)):
        expected = act(bundle.controller_shape, parameters[row], value, variant.controls)
        np.testing.assert_allclose(real.action[row], expected, atol=1e-5)


def drive(bundle, pictures, parameters):
    policy = PolicyStep(bundle)
    state, actions, states = policy.zero_state(1), [], []
    for each in pictures:
        states.append(state)
        step = policy.step(each[None], parameters, state)
        state = step.state
        actions.append(step.action[0])
    return np.stack(actions), np.concatenate(states)


def test_a_choice_is_held_and_the_memory_advances_each_step_with_it(random_bundle):
    varied = random_bundle.with_controllers(None, Variant(decide_every=3))
    pictures = np.random.default_rng(5).integers(0, 256, (8, 64, 64, 3), dtype=np.uint8)
    actions, states = drive(varied, pictures, vectors(varied, 1))
    held = [np.array_equal(one, other) for one, other in pairwise(actions)]
    assert held == [True, True, False, True, True, False, True]
    encoder, memory, state = Encoder(random_bundle), DreamStep(random_bundle), np.zeros((1, 512), np.float32)
    for picture, action, known in zip(pictures, actions, states, strict=True):
        assert np.array_equal(known[:512], state[0])
        latent, _ = encoder.encode(picture[None])
        state = memory.advance(latent, action[None], state)


def test_a_choice_and_its_change_are_those_of_decisions_not_of_held_steps(random_bundle):
    varied = random_bundle.with_controllers(None, Variant(pedals="one", decide_every=2, feedback="last"))
    pictures = np.random.default_rng(5).integers(0, 256, (7, 64, 64, 3), dtype=np.uint8)
    actions, states = drive(varied, pictures, vectors(varied, 1))
    choices = Controllers(varied).choices
    assert not choices.features(states[:1]).any()
    last, before = (varied.variant.controls.to_outputs(actions[step]) for step in (2, 0))
    assert np.array_equal(choices.features(states[4:5])[0], np.concatenate([last, last - before]))


def test_a_variant_that_says_nothing_is_the_one_graph_to_the_bit(random_bundle):
    silent = random_bundle.with_controllers(None, Variant.from_json('{"pedals": "two"}'))
    pictures = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    given = pictures, vectors(random_bundle, 3), np.zeros((3, 512), np.float32)
    steps = [PolicyStep(each).step(*given) for each in (random_bundle, silent)]
    assert all(np.array_equal(one, other) for one, other in zip(*steps, strict=True))
