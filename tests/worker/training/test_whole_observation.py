"""World models of the whole 96x96 observation, from rollouts in CarRacing to scores; kinds cannot be mixed."""

from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import DatasetError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.addons.driving.loop import DreamScene
from dreamfleet.worker.addons.evaluation.agents import make_agent
from dreamfleet.worker.addons.recording.recording import record
from dreamfleet.worker.scoring.episode import EpisodeConfig, score
from dreamfleet.worker.scoring.rollout import write_episode
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.assemble import assemble
from dreamfleet.worker.training.data.collect import collect, import_rollouts
from dreamfleet.worker.training.data.collect_config import CollectConfig
from dreamfleet.worker.training.data.dataset import episode_path, load_pictures
from dreamfleet.worker.training.encode import encode
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel import vae_config
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worlds.car_racing.preprocessing import RAW
from tests.support.drives import ignore, write_drive, write_drives

COLLECT = CollectConfig(episodes=3, steps=8, picture=96)
SHORT = TrainConfig(updates=2, batch=8, rate=1e-3)
VAE = replace(vae_config.NOTEBOOK, latent=6, channels=(4, 4, 8, 8))
RNN = MDNRNNConfig(latent=6, hidden=8, mixtures=2, done=True)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A data folder after all stages; read only."""
    folder = tmp_path_factory.mktemp("data")
    assert list(collect(folder, COLLECT, jobs=1)) == [8, 8, 8]
    train_vae.train_vae(folder, SHORT, ignore, VAE)
    assert list(encode(folder)) == [8, 8, 8]
    train_mdnrnn.train_mdnrnn(folder, SHORT, ignore, RNN)
    return folder


@pytest.fixture(scope="module")
def bundle(data):
    return assemble(data, data / "whole.zip", "whole", with_weights=False)


@pytest.fixture(scope="module")
def parameters(bundle):
    return np.random.default_rng(0).normal(size=bundle.controller_shape.size).astype(np.float32)


@pytest.mark.slow
def test_environment_judge_and_video_score_alike_to_the_bit(bundle, parameters, tmp_path):
    assert (bundle.manifest.preprocessing, bundle.manifest.picture) == (RAW.name, (96, 96, 3))
    scorer = Scorer(TaskSpec("car-racing", bundle.sha256, 70, 0), bundle)
    fitness = [scorer.score("score", parameters, 20_000).fitness]
    scorer.close()
    agent = make_agent(Controller(bundle.controller_shape, parameters, "car-racing", bundle.sha256), bundle)
    judge = agent.make_evaluation_environment()
    fitness.append(score(judge, agent.make_policies()(20_000), parameters, EpisodeConfig(20_000, 70)).fitness)
    judge.close()
    fitness.append(record(agent, 20_000, 70, tmp_path / "drive.mp4")[0])
    assert fitness == fitness[:1] * 3


@pytest.mark.slow
def test_it_dreams_is_driven_in_reality_and_collects_drives_that_its_data_set_takes_in(
    data, bundle, parameters, tmp_path
):
    scorer = Scorer(TaskSpec("dream", bundle.sha256, 20, 0), bundle)
    assert scorer.score("score", parameters, 2**20).steps <= 20
    score, kept = scorer.collect(parameters, 2**20)
    scorer.close()
    path = tmp_path / "kept.npz"
    with path.open("wb") as file:
        write_episode(file, kept.arrays())
    assert load_pictures(path).shape == (score.steps, 96, 96, 3)
    (tmp_path / "episodes").mkdir()
    episode_path(tmp_path, 0).write_bytes(episode_path(data, 0).read_bytes())
    assert list(import_rollouts(tmp_path, [path])) == [score.steps]


def test_its_dream_is_driven_at_the_size_of_any_other(bundle, random_bundle):
    for each in (bundle, random_bundle):
        scene = DreamScene(each, 1.0, 5)
        scene.environment.reset(seed=1)
        assert [side * scene.scale for side in scene.surface().get_size()] == [640, 640]


@pytest.mark.parametrize(("there", "wanted"), [(64, 96), (96, 64)])
def test_no_folder_gets_two_kinds_of_pictures(tmp_path, there, wanted):
    path = write_drive(tmp_path, 7, picture=there)
    with pytest.raises(DatasetError, match=rf"{path.name}.*{there}.*{wanted}"):
        list(collect(tmp_path, replace(COLLECT, picture=wanted), jobs=1))
    other = write_drive(tmp_path / "run", 0, picture=wanted)
    for folder, rollouts in ((tmp_path, [other]), (tmp_path / "new", [path, other])):
        with pytest.raises(DatasetError):
            list(import_rollouts(folder, rollouts))
    assert not (tmp_path / "new").exists()
    assert [each.name for each in (tmp_path / "episodes").iterdir()] == [path.name]


def test_a_vae_of_another_size_than_the_data_is_refused_before_anything_runs(tmp_path):
    write_drives(tmp_path, episodes=3, steps=4)
    with pytest.raises(DatasetError, match=r"'box-64'.*'raw-96'.*--picture"):
        train_vae.train_vae(tmp_path, SHORT, ignore, VAE)
    assert not (tmp_path / train_vae.CHECKPOINT).exists()
    train_vae.train_vae(tmp_path, SHORT, ignore, replace(VAE, picture=64))
    write_drive(tmp_path, 3, picture=96)
    with pytest.raises(DatasetError, match=r"000003.npz.*'raw-96'"):
        list(encode(tmp_path))
    assert not (tmp_path / "encoded").exists()
