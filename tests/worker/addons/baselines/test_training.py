"""The network learns in the real CarRacing; an interrupted training resumes to the same bits; its export drives alike.
Tests export.py, presets.py, progress.py, train.py, verb.py, worker/worlds/trained_agent.py and
worker/worlds/network_agent.py."""

import hashlib
import json
import pickle
import subprocess
import sys
import zipfile
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from dreamfleet.common.addons.evaluation_report import read_evaluation_report
from dreamfleet.common.artifacts.bundle import DREAM_GRAPH
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import ControllerError, DatasetError, StoppedError, UsageError
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.worker.addons.baselines import train
from dreamfleet.worker.addons.baselines import verb as baseline
from dreamfleet.worker.addons.baselines.export import export_agent, export_network
from dreamfleet.worker.addons.baselines.network import Networks, QPolicy
from dreamfleet.worker.addons.baselines.presets import AgentConfig, LearningConfig
from dreamfleet.worker.addons.baselines.train import CHECKPOINT, CURVE, episode_file, train_drqn
from dreamfleet.worker.addons.evaluation import evaluation
from dreamfleet.worker.addons.evaluation.agents import make_agent
from dreamfleet.worker.addons.evaluation.named_agents import find_agent, find_driver
from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.tasks.model_free_policies import NO_PARAMETERS
from dreamfleet.worker.training.checkpoint import load_config, load_progress, load_weights, save_checkpoint
from dreamfleet.worker.worldmodel.inference import open_graph
from dreamfleet.worker.worldmodel.vae import VAE
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from dreamfleet.worker.worlds.car_racing.native_check import make_car_racing
from dreamfleet.worker.worlds.network_agent import NetworkPolicy
from dreamfleet.worker.worlds.trained_agent import MANIFEST, NETWORK, TrainedAgent
from tests.support.disks import file_size_limit
from tests.support.verbs import run_verb

LAYERS = AgentConfig(channels=(2,), kernels=(8,), strides=(8,), hidden=4, frame_skip=3)
SHORT = LearningConfig(
    episodes=5, random_episodes=1, steps=24, batch=2, trace=2, burn_in=2, n_step=2, epsilon_first=0.5, rate=1e-2,
    learn_every=2, target_every=3, replay=20, report_every=2,
)  # fmt: skip
FLAGS = (
    "--set", "channels=2", "kernels=8", "strides=8", "hidden=4", "frame_skip=3", "random_episodes=1", "batch=2",
    "report_every=1", "learn_every=1", "--steps", "12",
)  # fmt: skip


class KilledError(BaseException):
    """Stands for a kill: no handler of the code under test catches it."""


def call(*words):
    return run_verb(baseline.TRAIN, *words)


def state(folder):
    """The bytes of all files that a training leaves."""
    weights = {name: array.tobytes() for name, array in load_weights(folder / CHECKPOINT).items()}
    kept = {path.name: path.read_bytes() for path in (folder / "replay").iterdir()}
    return weights, load_progress(folder / CHECKPOINT), (folder / CURVE).read_text(), kept


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    reports = []
    figures = train_drqn(folder, LAYERS, SHORT, lambda done, report: reports.append((done, report)))
    return folder, figures, reports


def test_it_drives_learns_and_reports(whole):
    folder, figures, reports = whole
    progress = load_progress(folder / CHECKPOINT)
    assert (figures["episodes"], figures["goal_reached"]) == (5, False)
    assert figures["updates"] == progress["update"] == 16  # every second of 8 decisions, in four episodes
    assert [each["decisions"] for each in progress["episodes"]] == [8] * 5
    assert [done for done, _ in reports] == list(range(6))
    assert [report.episode for _, report in reports if report] == [2, 4]
    curve = [json.loads(line) for line in (folder / CURVE).read_text().splitlines()]
    assert [(each["episode"], each["loss"] is None) for each in curve] == [(2, False), (4, False)]
    assert sorted(path.stem for path in (folder / "replay").iterdir()) == ["000003", "000004"]  # 16 of 20 decisions
    weights = load_weights(folder / CHECKPOINT)
    begun = Networks(LAYERS)
    assert {f"online.{name}" for name in begun.online.state_dict()} < set(weights)
    assert not np.array_equal(weights["online.value.weight"], weights["target.value.weight"])


@pytest.mark.slow
def test_a_kill_at_any_checkpoint_leads_to_the_same_files(whole, tmp_path, monkeypatch):
    real, writes = train.save_checkpoint, []

    def killed_at(number, *given):
        writes.append(given)
        if len(writes) == number:
            raise KilledError
        real(*given)

    for number in range(1, 7):
        writes.clear()
        monkeypatch.setattr(train, "save_checkpoint", partial(killed_at, number))
        folder = tmp_path / str(number)
        with pytest.raises(KilledError):
            train_drqn(folder, LAYERS, SHORT)
        train_drqn(folder, LAYERS, SHORT)
        assert state(folder) == state(whole[0])


def test_a_stop_says_how_to_go_on_and_costs_nothing(whole, tmp_path):
    steps = iter(range(10**6))
    with pytest.raises(StoppedError, match=r"3.*5.*drqn\.safetensors"):
        train_drqn(tmp_path, LAYERS, SHORT, stop=lambda: next(steps) == 60)
    assert len(load_progress(tmp_path / CHECKPOINT)["episodes"]) == 2
    train_drqn(tmp_path, LAYERS, SHORT)
    assert state(tmp_path) == state(whole[0])


def test_new_begins_anew(whole, tmp_path):
    train_drqn(tmp_path, LAYERS, replace(SHORT, seed=7, episodes=1))
    train_drqn(tmp_path, replace(LAYERS, hidden=5), replace(SHORT, episodes=1), new=True)
    train_drqn(tmp_path, LAYERS, SHORT, new=True)
    assert state(tmp_path) == state(whole[0])


def test_the_goal_ends_it(tmp_path):
    assert train_drqn(tmp_path, LAYERS, replace(SHORT, goal=-1000))["goal_reached"]
    assert len(load_progress(tmp_path / CHECKPOINT)["episodes"]) == 2


def test_flags_change_what_a_preset_says(tmp_path, capsys):
    assert call("drqn", "--data", tmp_path, *FLAGS, "--episodes", 2, "--preset", "notebook", "--json") == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["episodes"] == 2
    assert "1:" in printed.err
    found = load_config(tmp_path / CHECKPOINT, AgentConfig)
    assert found == replace(LAYERS, picture=96, choices="notebook", heads="softmax")
    with pytest.raises(DatasetError, match=r"picture 96.*64.*choices notebook.*--new"):
        call("drqn", "--data", tmp_path, *FLAGS, "--episodes", 3)
    with pytest.raises(UsageError, match="`dreamfleet evaluate --controller random-discrete`"):
        call("random-discrete", "--data", tmp_path)


def test_a_damaged_or_missing_file_is_one_line(whole, tmp_path):
    for name in (CHECKPOINT, "replay/000003.npz", "replay/000004.npz"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes((whole[0] / name).read_bytes())
    longer = replace(SHORT, episodes=6)
    path = episode_file(tmp_path, 3)
    content = path.read_bytes()
    path.write_bytes(content[:-30])
    with pytest.raises(DatasetError, match=r"000003\.npz.*--new"):
        train_drqn(tmp_path, LAYERS, longer)
    path.unlink()
    with pytest.raises(DatasetError, match=r"000003\.npz"):
        train_drqn(tmp_path, LAYERS, longer)
    path.write_bytes(content)
    (tmp_path / CHECKPOINT).write_bytes((whole[0] / CHECKPOINT).read_bytes()[:-30])
    with pytest.raises(DatasetError, match=r"drqn\.safetensors"):
        train_drqn(tmp_path, LAYERS, longer)


def test_a_checkpoint_with_nonsense_is_one_line(whole, tmp_path):
    networks = Networks(LAYERS)
    good = load_progress(whole[0] / CHECKPOINT)
    episodes = good["episodes"]
    for wrong in (
        {"update": 1}, {**good, "oldest": -5}, {**good, "oldest": 6}, {**good, "episodes": 5}, [],
        {**good, "episodes": [{}]}, {**good, "episodes": [{**episodes[0], "score": None}]},
        {**good, "update": float("nan")},
    ):  # fmt: skip
        save_checkpoint(tmp_path / CHECKPOINT, networks, torch.optim.Adam(networks.parameters()), wrong)
        with pytest.raises(DatasetError, match=r"drqn\.safetensors"):
            train_drqn(tmp_path, LAYERS, SHORT)


def test_a_second_training_in_a_folder_is_refused_while_the_first_one_runs(tmp_path):
    def begin_another(done, _report):
        if done == 1:
            with pytest.raises(UsageError, match=str(tmp_path)):
                train_drqn(tmp_path, LAYERS, SHORT)

    train_drqn(tmp_path, LAYERS, replace(SHORT, episodes=1), begin_another)


def test_a_full_disk_is_one_line_and_the_last_checkpoint_stays(whole, tmp_path):
    with file_size_limit() as limit, pytest.raises(DatasetError, match=r"000003\.npz"):
        train_drqn(tmp_path, LAYERS, SHORT, lambda done, _: limit(2000) if done == 3 else None)
    train_drqn(tmp_path, LAYERS, SHORT)
    assert state(tmp_path) == state(whole[0])


@pytest.mark.parametrize(
    ("settings", "change"),
    [
        *((LAYERS, each) for each in (
            {"picture": 80}, {"kernels": (3, 3)}, {"kernels": (65,)}, {"frame_skip": 0}, {"frame_skip": 10**9},
            {"hidden": 10**9},
        )),
        *((SHORT, each) for each in (
            {"batch": 0}, {"batch": 10**9}, {"burn_in": -1}, {"gamma": 1.5}, {"rate": 0.0}, {"rate": float("inf")},
            {"clip": float("nan")}, {"goal": float("nan")}, {"seed": 10**20}, {"n_step": 10**9},
        )),
    ],
)  # fmt: skip
def test_impossible_settings_are_refused(settings, change):
    with pytest.raises(UsageError):
        replace(settings, **change)


def test_a_memory_goes_through_time_as_along_a_trace():
    torch.manual_seed(0)
    network = Networks(LAYERS).online
    pictures = np.random.default_rng(0).integers(0, 256, (5, 64, 64, 3), dtype=np.uint8)
    policy = QPolicy(network)
    policy.begin(NO_PARAMETERS)
    chosen = []
    for picture in np.repeat(pictures, LAYERS.frame_skip, axis=0):
        policy.act(picture)
        if policy.is_new_decision:
            chosen.append(policy.choice)
    with torch.no_grad():
        features = network.features(torch.from_numpy(pictures[None]))
        worth, memory = network(features)
        padded = torch.cat([torch.zeros(1, 2, features.shape[2]), features[:, :3]], dim=1)
        warm_up = network.warm_up(padded, torch.tensor([[0.0, 0, 1, 1, 1]]))
        later, _ = network(features[:, 3:], warm_up)
    assert chosen == worth[0].argmax(dim=-1).tolist()
    torch.testing.assert_close(policy._memory, memory)
    torch.testing.assert_close(later, worth[:, 3:])


SEED, STEPS = 20_000, 8
DRIVER = AgentConfig(channels=(4, 4), kernels=(8, 4), strides=(4, 2), hidden=8, frame_skip=3)
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
    return keep(tmp_path / "training", networks_of(DRIVER))


@pytest.fixture
def file(trained, tmp_path):
    path = tmp_path / "driver.zip"
    export_agent(trained).save(path)
    return path


@pytest.mark.parametrize(
    "layers", [DRIVER, AgentConfig(picture=96, choices="notebook", heads="softmax", channels=(4,), kernels=(8,),
                                   strides=(8,), hidden=16)]
)  # fmt: skip
@pytest.mark.slow
def test_it_chooses_what_the_network_chooses_all_episode_long(layers, tmp_path):
    networks = networks_of(layers, 1)
    agent = make_agent(export_agent(keep(tmp_path, networks)))
    environment = make_car_racing(preprocessing=agent.trained.manifest.preprocessing)
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
    networks = networks_of(DRIVER)
    weights = {name: tensor.numpy() for name, tensor in networks.online.state_dict().items()}
    run = open_graph(export_network(weights, DRIVER), threads=1).run
    pictures = np.random.default_rng(0).integers(0, 256, (6, 64, 64, 3)).astype(np.uint8)
    with torch.no_grad():
        wanted = networks.online(networks.online.features(torch.from_numpy(pictures[None])))[0][0].numpy()
    state = np.zeros((1, 16), np.float32)
    for picture, row in zip(pictures, wanted, strict=True):
        worth, state = run(["worth", "next_state"], {"picture": picture[None], "state": state})
        assert worth[0] == pytest.approx(row, abs=1e-4)


@pytest.mark.slow
def test_a_file_describes_its_training_and_is_reproducible(tmp_path, capsys):
    train_drqn(tmp_path / "training", DRIVER, LEARNING)
    words = ["baseline", "export", "drqn", "--data", str(tmp_path / "training"), "--json", "--out"]
    assert main([*words, str(tmp_path / "one.zip")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert main([*words, str(tmp_path / "other.zip")]) == 0
    assert (tmp_path / "one.zip").read_bytes() == (tmp_path / "other.zip").read_bytes()
    agent = TrainedAgent.load(tmp_path / "one.zip")
    assert (found["sha256"], found["episodes"], found["steps"]) == (agent.sha256, 2, 24)
    made = agent.manifest.provenance
    assert made["learning"] == asdict(LEARNING)
    assert made["layers"]["hidden"] == DRIVER.hidden
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
    weights = networks_of(DRIVER).online.state_dict()
    spoilt = {name: tensor.numpy() * np.float32("nan") for name, tensor in weights.items()}
    halved, nonsense = content[: len(content) // 2], b"no network at all"
    for network in (b"", random_bundle.read(DREAM_GRAPH), halved, export_network(spoilt, DRIVER), nonsense):
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
    networks = networks_of(DRIVER)
    networks.online.value.weight.data[:] = float("nan")
    with pytest.raises(DatasetError):
        export_agent(keep(tmp_path / "spoilt", networks))
