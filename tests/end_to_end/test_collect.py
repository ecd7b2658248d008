"""A run keeps drives of its own mean: the same files on disk, with any workers and any losses.
Tests coordinator/jobs/rollout_collection.py, worker/scoring/rollout.py and worker/service/outbox.py."""

import io
import re

import numpy as np
import pytest

from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.seeds import collection_seed
from dreamfleet.worker.training.data.dataset import episode_paths, load_pictures
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX, RAW
from tests.support import tasks
from tests.support.bundles import write_random_bundle
from tests.support.same_bits import evolve

GENERATIONS, DRIVES = 4, 3


@pytest.fixture
def settings(small):
    return (*small, "--collect-every", 2, "--collect-episodes", DRIVES, "--generations", GENERATIONS, "--seed", 5)


def kept(processes, name):
    """Each drive's place and bytes; the journal says that there are no more."""
    with open_run(processes.runs, name) as run:
        paths = run.rollouts()
        assert sorted(path.name for path in (run.path / "rollouts").iterdir()) == [path.name for path in paths]
        return {path.name: path.read_bytes() for path in paths}


def expected(generations=(1, 3)):
    return [f"{generation:06d}-{episode:04d}.npz" for generation in generations for episode in range(DRIVES)]


@pytest.mark.slow
def test_the_drives_are_a_function_of_the_run_and_not_of_the_worker(processes, settings):
    seen = []
    for name, workers in (("one", 1), ("three", 3)):
        evolve(processes, name, workers, *settings, "--task", tasks.TOY, task=tasks.TOY)
        seen.append(kept(processes, name))
    assert seen[0] == seen[1]
    assert sorted(seen[0]) == expected()
    with open_run(processes.runs, "one") as run:
        results = run.results(3, 0, "collect")
        assert [each.seed for each in results] == [collection_seed(5, 3, episode) for episode in range(DRIVES)]
        scored = {each.seed for g in range(GENERATIONS) for i in range(4) for each in run.results(g, i)}
        assert not scored & {each.seed for each in results}
    with np.load(io.BytesIO(seen[0][expected()[0]])) as drive:
        assert set(drive) == {"picture", "action", "reward", "ended", "driver", "preprocessing", "world"}
        assert str(drive["driver"]) == "controller"
        assert len(drive["action"]) == len(drive["reward"]) == len(drive["picture"]) == 10
        with open_run(processes.runs, "one") as run:
            assert run.results(1, 0, "collect")[0].fitness == pytest.approx(drive["reward"].sum(), rel=1e-5)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")
@pytest.mark.parametrize("preprocessing", [BOX, pytest.param(RAW, marks=pytest.mark.long)])
def test_drives_of_the_real_car_are_episodes_that_a_data_set_takes_in_once(processes, tmp_path, preprocessing):
    vae = VAEConfig(picture=preprocessing.size, latent=4, channels=(2, 2, 2, 2))
    bundle = write_random_bundle(tmp_path / "b.zip", vae=vae, rnn=MDNRNNConfig(latent=4, hidden=4))
    evolve(
        processes, "test", 1, "--bundle", bundle.path, "--population", 2, "--episodes", 1, "--horizon", 30,
        "--evaluate-every", 0, "--collect-every", 1, "--collect-episodes", 2, "--generations", 1,
    )  # fmt: skip
    data = tmp_path / "data"
    for new in (2, 0):
        out = processes.printed("collect", "--data", data, "--from-run", "test", "--runs-dir", processes.runs)
        assert re.search(rf"\b{new} .* {30 * new} .* 2\b", out)
    with open_run(processes.runs, "test") as run:
        assert [path.read_bytes() for path in run.rollouts()] == [path.read_bytes() for path in episode_paths(data)]
    for path in episode_paths(data):
        pictures = load_pictures(path)
        assert pictures.shape == (30, *preprocessing.shape)
        assert pictures.dtype == np.uint8
        with np.load(path) as drive:
            assert drive["action"].shape == (30, 3)
            assert str(drive["preprocessing"]) == preprocessing.name
            assert not drive["ended"]
