"""An exported agent drives like the trained network, without torch; any other file is refused.
Tests common/artifacts/trained_agent.py and worker/worlds/car_racing/agents.py."""

import hashlib
import json
import pickle
import subprocess
import sys
import zipfile
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dreamfleet.common.artifacts.bundle import DREAM_GRAPH
from dreamfleet.common.artifacts.trained_agent import MANIFEST, NETWORK, TrainedAgent
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import ControllerError, DatasetError
from dreamfleet.common.runs.lookup import find_agent, find_controller
from dreamfleet.worker.addons.baselines.export import export_agent, export_network
from dreamfleet.worker.addons.baselines.network import Networks, QPolicy
from dreamfleet.worker.addons.baselines.presets import AgentConfig, LearningConfig
from dreamfleet.worker.addons.baselines.train import CHECKPOINT, train_drqn
from dreamfleet.worker.addons.evaluation import evaluation
from dreamfleet.worker.addons.evaluation.agents import make_agent
from dreamfleet.worker.addons.evaluation.evaluation_report import read_evaluation_report
from dreamfleet.worker.addons.evaluation.named_agents import find_driver
from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.tasks.model_free_policies import NO_PARAMETERS
from dreamfleet.worker.training.checkpoint import save_checkpoint
from dreamfleet.worker.worldmodel.inference import open_graph
from dreamfleet.worker.worldmodel.vae import VAE
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from dreamfleet.worker.worlds.car_racing.agents import NetworkPolicy
from dreamfleet.worker.worlds.car_racing.native_check import make_car_racing

SEED, STEPS = 20_000, 8
LAYERS = AgentConfig(channels=(4, 4), kernels=(8, 4), strides=(4, 2), hidden=8, frame_skip=3)
LEARNING = LearningConfig(episodes=2, random_episodes=1, steps=12, batch=2, report_every=1, learn_every=1)


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(evaluation, "EpisodeConfig", lambda seed, _horizon: EpisodeConfig(seed, STEPS))
    monkeypatch.setattr(evaluation, "evaluate_in_processes", evaluation.evaluate)  # a child would not know it


def networks_of(layers, seed=0):
    """Networks with weights so large that pictures make a difference."""
    torch.manual_seed(seed)
    networks = Networks(layers).eval()
    for each in networks.online.parameters():
        each.data *= 3
    return networks


def keep(folder, networks, episodes=()):
    optimiser = torch.optim.Adam(networks.parameters())
    save_checkpoint(folder / CHECKPOINT, networks, optimiser, {"update": 7, "oldest": 0, "episodes": list(episodes)})
    return folder


@pytest.fixture
def trained(tmp_path):
    return keep(tmp_path / "training", networks_of(LAYERS))


@pytest.fixture
def file(trained, tmp_path):
    path = tmp_path / "driver.zip"
    export_agent(trained).save(path)
    return path


@pytest.mark.parametrize(
    "layers", [LAYERS, AgentConfig(picture=96, choices="notebook", heads="softmax", channels=(4,), kernels=(8,),
                                   strides=(8,), hidden=16)]
)  # fmt: skip
@pytest.mark.slow
def test_it_chooses_what_the_network_chooses_all_episode_long(layers, tmp_path):
    networks = networks_of(layers, 1)
    agent = make_agent(export_agent(keep(tmp_path, networks)))
    environment = make_car_racing(preprocessing=agent.preprocessing)
    torchs, exported = QPolicy(networks.online), agent.make_policies()(SEED)
    chosen = []
    for each in (torchs, exported):
        each.begin(NO_PARAMETERS)
    for moment in run_episode(environment, torchs, EpisodeConfig(SEED, 1000)):
        chosen.append(torchs.choice)
        assert exported.act(moment.seen).tolist() == moment.action.tolist()
        assert exported.is_new_decision == torchs.is_new_decision
    assert len(chosen) > 100
    assert len(set(chosen)) > 1
    environment.close()


def test_it_gives_the_same_worth_through_time():
    networks = networks_of(LAYERS)
    weights = {name: tensor.numpy() for name, tensor in networks.online.state_dict().items()}
    run = open_graph(export_network(weights, LAYERS), threads=1).run
    pictures = np.random.default_rng(0).integers(0, 256, (6, 64, 64, 3)).astype(np.uint8)
    with torch.no_grad():
        wanted = networks.online(networks.online.features(torch.from_numpy(pictures[None])))[0][0].numpy()
    state = np.zeros((1, 16), np.float32)
    for picture, row in zip(pictures, wanted, strict=True):
        worth, state = run(["worth", "next_state"], {"picture": picture[None], "state": state})
        assert worth[0] == pytest.approx(row, abs=1e-4)


@pytest.mark.slow
def test_a_file_describes_its_training_and_is_reproducible(tmp_path, capsys):
    train_drqn(tmp_path / "training", LAYERS, LEARNING)
    words = ["baseline", "export", "drqn", "--data", str(tmp_path / "training"), "--json", "--out"]
    assert main([*words, str(tmp_path / "one.zip")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert main([*words, str(tmp_path / "other.zip")]) == 0
    assert (tmp_path / "one.zip").read_bytes() == (tmp_path / "other.zip").read_bytes()
    agent = TrainedAgent.load(tmp_path / "one.zip")
    assert (found["sha256"], found["episodes"], found["steps"]) == (agent.sha256, 2, 24)
    made = agent.manifest.provenance
    assert made["learning"] == asdict(LEARNING)
    assert made["layers"]["hidden"] == LAYERS.hidden
    assert (made["decisions"], made["updates"] > 0) == (8, True)
    assert (agent.manifest.frame_skip, len(agent.manifest.choices), agent.task) == (3, 5, "car-racing")


def test_a_training_and_its_file_give_the_same_report_and_compare_takes_both(trained, file, tmp_path, capsys):
    one, other = (str(tmp_path / name) for name in ("one.json", "other.json"))
    for who, out in ((file, one), (trained, other)):
        drives = ["--episodes", "3", "--first-seed", str(SEED), "--jobs", "1", "--out", out]
        assert main(["evaluate", "--controller", str(who), *drives]) == 0
    found = [read_evaluation_report(Path(out)) for out in (one, other)]
    assert replace(found[0], name="", seconds=0) == replace(found[1], name="", seconds=0)
    assert {each.steps for each in found[0].drives} == {STEPS}
    assert all(each.speed is not None and each.braking is not None for each in found[0].drives)
    assert "torch" not in found[0].fingerprint
    capsys.readouterr()
    assert main(["compare", one, other, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["differences"][0]["mean"] == 0
    assert main(["verify", "report", one, "--jobs", "1"]) == 0


def test_it_goes_to_other_processes(file):
    agent = make_agent(TrainedAgent.load(file))
    again = pickle.loads(pickle.dumps(agent))
    assert evaluation.AgentEvaluator(again).drive(SEED) == evaluation.AgentEvaluator(agent).drive(SEED)


def test_neither_torch_nor_onnx_is_needed_to_drive(file):
    script = f"""
import sys
sys.modules.update(torch=None, onnx=None, safetensors=None)
import dreamfleet
agent = dreamfleet.find_agent({str(file)!r})
environment, policy = dreamfleet.make_environment(agent), dreamfleet.make_policy(agent)
observation, _ = environment.reset(seed={SEED})
for _ in range(5):
    observation, *_ = environment.step(policy.act(observation))
print(observation.shape)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.splitlines()[-1:]) == (0, ["(64, 64, 3)"]), done.stderr


def test_where_parameters_are_needed_an_agent_is_refused(file, tmp_path):
    with pytest.raises(ControllerError):
        find_controller(str(file), tmp_path)


def rewritten(file, change=lambda about: about, network=None):
    """The file with another manifest or network."""
    with zipfile.ZipFile(file) as archive:
        about, found = json.loads(archive.read(MANIFEST)), archive.read(NETWORK)
    if network is not None:
        about["network"] = hashlib.sha256(network).hexdigest()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(MANIFEST, json.dumps(change(about)))
        archive.writestr(NETWORK, found if network is None else network)
    return file


@pytest.mark.parametrize(
    "change",
    [
        {"format": 9}, {"network": "ab" * 32}, {"frame_skip": 0}, {"frame_skip": True}, {"state": 10**9},
        {"state": 4}, {"choices": []}, {"choices": [[float("nan"), 0, 0]] * 5}, {"choices": [[1e9, 0, 0]] * 5},
        {"choices": [[0, 0]] * 5}, {"choices": [[0, 0, 0]] * 4}, {"choices": None}, {"more": 1},
        {"preprocessing": "raw-96"}, {"preprocessing": "sharp-7"}, {"task": "moon"}, None,
    ],
)  # fmt: skip
def test_a_wrong_manifest_is_one_line(file, tmp_path, change):
    def changed(about):
        return [] if change is None else {name: each for name, each in (about | change).items() if each is not None}

    with pytest.raises(ControllerError) as caught:
        make_agent(find_agent(str(rewritten(file, changed)), tmp_path)[0])
    assert "\n" not in str(caught.value)


def test_a_wrong_network_is_one_line(file, tmp_path, random_bundle):
    whole, content = file.read_bytes(), TrainedAgent.load(file).network
    weights = networks_of(LAYERS).online.state_dict()
    spoilt = {name: tensor.numpy() * np.float32("nan") for name, tensor in weights.items()}
    halved, nonsense = content[: len(content) // 2], b"no network at all"
    for network in (b"", random_bundle.read(DREAM_GRAPH), halved, export_network(spoilt, LAYERS), nonsense):
        file.write_bytes(whole)
        with pytest.raises(ControllerError) as caught:
            make_agent(find_agent(str(rewritten(file, network=network)), tmp_path)[0])
        assert "\n" not in str(caught.value)


def test_what_is_no_whole_file_is_one_line(file, tmp_path, capsys):
    whole = file.read_bytes()
    half = len(whole) // 2
    flipped = whole[:half] + bytes([whole[half] ^ 1]) + whole[half + 1 :]
    for content in (b"", whole[:-30], whole[:half], b"\0" * 100, flipped):
        file.write_bytes(content)
        assert main(["evaluate", "--controller", str(file), "--episodes", "1"]) == 1
        assert len(capsys.readouterr().err.splitlines()) == 1
    with pytest.raises(ControllerError):
        TrainedAgent.load(tmp_path)


def test_a_network_that_gives_nan_ends_the_drive(file):
    agent = TrainedAgent.load(file)
    policy = NetworkPolicy(agent)
    policy._state = np.full_like(policy._state, np.nan)
    with pytest.raises(ControllerError):
        policy.choose(np.zeros((64, 64, 3), np.uint8))


def test_a_folder_without_a_sound_training_has_no_agent(trained, tmp_path):
    with pytest.raises(ControllerError):
        find_driver(str(tmp_path / "absent"), tmp_path)
    path, other = trained / CHECKPOINT, keep(tmp_path / "vae", VAE(VAEConfig(latent=4, channels=(2, 2, 4, 4))))
    path.write_bytes(path.read_bytes()[:-50])
    for folder in (trained, other):
        with pytest.raises(DatasetError, match=r"drqn\.safetensors"):
            find_driver(str(folder), tmp_path)


def test_what_cannot_be_exported_is_one_line(tmp_path, capsys):
    assert main(["baseline", "export", "random", "--data", str(tmp_path), "--out", str(tmp_path / "a.zip")]) == 2
    assert "random" in capsys.readouterr().err
    networks = networks_of(LAYERS)
    networks.online.value.weight.data[:] = float("nan")
    with pytest.raises(DatasetError):
        export_agent(keep(tmp_path / "spoilt", networks))
