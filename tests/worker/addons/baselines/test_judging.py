"""Baselines are evaluated and recorded in gymnasium's own environment, like controllers.
Tests worker/worlds/car_racing/agents.py and worker/tasks/policy.py."""

import json
from pathlib import Path

import av
import pytest
import torch

from dreamfleet.common.cli import command_line
from dreamfleet.common.errors import ControllerError, DatasetError
from dreamfleet.worker.addons.baselines.network import Networks
from dreamfleet.worker.addons.baselines.presets import DISCRETE, DRQN, NAMES, RANDOM, AgentConfig
from dreamfleet.worker.addons.baselines.train import CHECKPOINT
from dreamfleet.worker.addons.evaluation import evaluation
from dreamfleet.worker.addons.evaluation.evaluation_report import read_evaluation_report
from dreamfleet.worker.addons.evaluation.named_agents import find_driver
from dreamfleet.worker.addons.recording.recording import record
from dreamfleet.worker.scoring.episode import EpisodeConfig
from dreamfleet.worker.training.checkpoint import save_checkpoint
from dreamfleet.worker.worldmodel.vae import VAE
from dreamfleet.worker.worldmodel.vae_config import VAEConfig

SEED, STEPS = 20_000, 6
LAYERS = AgentConfig(channels=(2,), kernels=(8,), strides=(8,), hidden=4, frame_skip=4, picture=96)


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(evaluation, "EpisodeConfig", lambda seed, _horizon: EpisodeConfig(seed, STEPS))
    monkeypatch.setattr(evaluation, "evaluate_in_processes", evaluation.evaluate)  # a child would not know it


def keep(folder, model):
    optimiser = torch.optim.Adam(model.parameters())
    save_checkpoint(folder / CHECKPOINT, model, optimiser, {"update": 0, "oldest": 0, "episodes": []})
    return folder


@pytest.fixture
def trained(tmp_path):
    torch.manual_seed(0)
    return keep(tmp_path / "trained", Networks(LAYERS))


def call(*words):
    return command_line.main(list(map(str, words)))


@pytest.mark.parametrize("name", NAMES)
def test_a_judgement_is_a_controllers_and_the_same_again(name, trained, tmp_path, capsys):
    out, who = tmp_path / "figures.json", trained if name == DRQN else name
    flags = ("--episodes", 2, "--first-seed", SEED, "--jobs", 1, "--json", "--out", out)
    words = ("evaluate", "--controller", who, *flags)
    assert call(*words) == 0
    printed = capsys.readouterr()
    found = read_evaluation_report(out)
    assert json.loads(printed.out)["scores"] == list(found.results.scores)
    assert (found.world, found.bundle, found.results.seeds) == ("car-racing", "", (SEED, SEED + 1))
    assert {each.steps for each in found.drives} == {STEPS}
    assert all(each.speed is not None and each.braking is not None for each in found.drives)
    assert call(*words) == 0
    assert read_evaluation_report(out).drives == found.drives


def test_chance_is_the_episodes_and_within_the_world():
    for name in (RANDOM, DISCRETE):
        policies = find_driver(name, Path()).make_policies()
        drawn = [[policies(seed).act(None).tolist() for seed in (1, 2, 3)] for _ in range(2)]
        assert drawn[0] == drawn[1]
        assert len({*map(tuple, drawn[0])}) > 1
    policy = find_driver(DISCRETE, Path()).make_policies()(0)
    assert len({tuple(policy.act(None)) for _ in range(200)}) == 5


def test_a_video_has_a_frame_a_step_and_the_drives_score(trained, tmp_path, capsys):
    out = tmp_path / "drive.mp4"
    assert call("record", "--controller", trained, "--seed", SEED, "--steps", STEPS, "--out", out, "--json") == 0
    score = json.loads(capsys.readouterr().out)["score"]
    assert score == evaluation.AgentEvaluator(find_driver(str(trained), Path())).drive(SEED).score
    assert score == record(find_driver(str(trained), Path()), SEED, STEPS, out)
    with av.open(str(out)) as container:
        assert len(list(container.decode(container.streams.video[0]))) == STEPS


def test_what_is_no_agent_is_one_line(trained, tmp_path):
    with pytest.raises(ControllerError):
        find_driver(str(tmp_path / "absent"), Path())
    folder = keep(tmp_path / "vae", VAE(VAEConfig(latent=4, channels=(2, 2, 4, 4))))
    with pytest.raises(DatasetError, match=r"drqn\.safetensors"):
        find_driver(str(folder), Path())
    path = trained / CHECKPOINT
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(DatasetError, match=r"drqn\.safetensors"):
        find_driver(str(trained), Path())
