"""The network learns in the real CarRacing; an interrupted training resumes to the same bits.
Tests presets.py, progress.py, train.py and verb.py."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from dreamfleet.common.errors import DatasetError, StoppedError, UsageError
from dreamfleet.worker.addons.baselines import train
from dreamfleet.worker.addons.baselines import verb as baseline
from dreamfleet.worker.addons.baselines.network import Networks, QPolicy
from dreamfleet.worker.addons.baselines.presets import AgentConfig, LearningConfig
from dreamfleet.worker.addons.baselines.train import CHECKPOINT, CURVE, episode_file, train_drqn
from dreamfleet.worker.tasks.model_free_policies import NO_PARAMETERS
from dreamfleet.worker.training.checkpoint import load_config, load_progress, load_weights, save_checkpoint
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
