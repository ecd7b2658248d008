import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from dreamfleet.common.artifacts.actions import STEERING_GAS_BRAKE
from dreamfleet.common.artifacts.bundle import POLICY, write_bundle
from dreamfleet.common.artifacts.controller import act
from dreamfleet.common.errors import BundleError
from dreamfleet.worker.worldmodel.inference import Decoder, Encoder, PolicyStep, open_part
from tests.support.models import random_models

ROWS = 64


@pytest.fixture(scope="module")
def inputs():
    random = np.random.default_rng(0)
    return (
        random.integers(0, 256, (ROWS, 64, 64, 3), dtype=np.uint8),
        random.normal(0, 0.1, (ROWS, 867)).astype(np.float32),
        np.concatenate([random.uniform(-0.9, 0.9, (ROWS, 256)), random.normal(0, 1, (ROWS, 256))], axis=1).astype(
            np.float32
        ),
    )


def test_the_runtime_keeps_no_identifier_and_reports_nothing(tmp_path):
    surroundings = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    words = [sys.executable, "-c", "import dreamfleet.worker.worldmodel.inference, onnxruntime"]
    subprocess.run(words, env={**surroundings, "HOME": str(tmp_path)}, check=True)
    assert not list(tmp_path.rglob("*onnxruntime*"))


@pytest.mark.parametrize("batch", [1, 3, 8, 64])
def test_a_rows_bits_do_not_depend_on_its_batch(random_bundle, inputs, batch):
    policy = PolicyStep(random_bundle)
    alone = [policy.step(*(each[row : row + 1] for each in inputs)) for row in range(ROWS)]
    for start in range(0, ROWS - batch + 1, batch):
        together = policy.step(*(each[start : start + batch] for each in inputs))
        for offset in range(batch):
            for one, many in zip(alone[start + offset], together, strict=True):
                assert np.array_equal(one[0], many[offset])


def test_a_rows_bits_do_not_depend_on_its_neighbours(random_bundle, inputs):
    policy = PolicyStep(random_bundle)
    order = np.random.default_rng(1).permutation(ROWS)
    straight, shuffled = policy.step(*inputs), policy.step(*(each[order] for each in inputs))
    assert all(np.array_equal(one[order], other) for one, other in zip(straight, shuffled, strict=True))


def test_the_graph_acts_as_the_controllers_formula(random_bundle, inputs):
    step = PolicyStep(random_bundle).step(*inputs)
    for row in range(ROWS):
        features = np.concatenate([step.latent[row], inputs[2][row, :256]])
        expected = act(random_bundle.controller_shape, inputs[1][row], features, STEERING_GAS_BRAKE)
        np.testing.assert_allclose(step.action[row], expected, atol=2e-6)
    assert step.action[:, 1:].min() >= 0
    assert np.abs(step.action).max() <= 1


def test_the_graphs_compute_what_torch_does(random_bundle, inputs):
    vae, rnn = random_models(0)
    pixels = torch.from_numpy(inputs[0]).permute(0, 3, 1, 2).float() / 255
    step = PolicyStep(random_bundle).step(*inputs)
    with torch.no_grad():
        mu, logvar = vae.encode(pixels)
        steps = torch.from_numpy(np.concatenate([step.latent, step.action], axis=1))[:, None]
        state = tuple(
            torch.from_numpy(each)[None]
            for each in np.ascontiguousarray(inputs[2].reshape(ROWS, 2, 256).transpose(1, 0, 2))
        )
        _, (hidden, cell) = rnn.lstm(steps, state)
        decoded = vae.decode(mu).permute(0, 2, 3, 1).numpy() * 255
    np.testing.assert_allclose(step.latent, mu.numpy(), atol=1e-5)
    np.testing.assert_allclose(step.state, np.concatenate([hidden[0], cell[0]], axis=1), atol=1e-5)
    for one, other in zip(Encoder(random_bundle).encode(inputs[0]), (mu, logvar), strict=True):
        np.testing.assert_allclose(one, other.numpy(), atol=1e-5)
    np.testing.assert_allclose(Decoder(random_bundle).decode(mu.numpy()), decoded, atol=1.0)


def test_a_part_that_is_no_graph_is_an_error_of_the_bundle(random_bundle, tmp_path):
    parts = {name: random_bundle.read(name) for name in random_bundle.manifest.parts}
    broken = write_bundle(tmp_path / "broken.zip", random_bundle.manifest, {**parts, POLICY: b"no graph"})
    with pytest.raises(BundleError, match=r"policy\.onnx"):
        open_part(broken, POLICY)
