"""An agent in the exact layout of google/brain-tokyo-workshop, AttentionAgent, `pretrained/TakeCover/model.npz`.

`BaseTorchSolution.get_params` (`solutions/torch_solutions.py`) writes it: of each layer the parameters in order of
their names. Its layers are `_fc_q`, `_fc_k`, torch's LSTM and a linear one; the public file has `params` (3633,)
float32. Patches are flattened as (row, column, colour), and ranked by the column sums of the softmax of rows."""

import json
import pickle
import re
import shlex
from dataclasses import replace

import numpy as np
import pytest
import torch

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import ControllerError
from dreamfleet.worker.addons.evaluation.agents import make_agent, masked
from dreamfleet.worker.addons.importing.sources import find_attention_agent
from dreamfleet.worker.worlds.trained_agent import TrainedAgent
from tests.support.doom import use_fake

SIZE = 3633


def layers():
    with torch.random.fork_rng(devices=()):
        torch.manual_seed(5)
        return [
            torch.nn.Linear(147, 4), torch.nn.Linear(147, 4), torch.nn.LSTM(20, 16), torch.nn.Linear(16, 1)
        ]  # fmt: skip


def parameters(theirs):
    states = [layer.state_dict() for layer in theirs]
    return np.concatenate([state[name].numpy().ravel() for state in states for name in sorted(state)])


@pytest.fixture
def file(tmp_path):
    np.savez(tmp_path / "model.npz", params=parameters(layers()))
    return tmp_path / "model.npz"


@pytest.fixture
def agent(file, tmp_path):
    assert main(["import", str(file), "--out", str(tmp_path / "agent.zip")]) == 0
    return tmp_path / "agent.zip"


def play_theirs(pictures):
    """Its outputs on pictures `(T, 96, 96, 3)`, in torch and double precision."""
    query, key, memory, out = (layer.double().requires_grad_(False) for layer in layers())
    state, outputs = None, []
    for picture in torch.from_numpy(pictures).double() / 255:
        starts = range(0, 90, 4)
        patches = torch.stack(
            [picture[row : row + 7, column : column + 7].ravel() for row in starts for column in starts]
        )
        votes = torch.softmax(query(patches) @ key(patches).T / 147**0.5, dim=1).sum(dim=0)
        most = torch.argsort(votes, descending=True)[:10]
        places = torch.stack([3 + 4 * (most // 23), 3 + 4 * (most % 23)], dim=1).double() / 96
        value, state = memory(places.view(1, 1, -1), state)
        outputs.append(torch.tanh(out(value)).item())
    return np.array(outputs)


def test_it_acts_as_in_its_program(agent):
    trained = TrainedAgent.load(agent)
    policy = make_agent(trained).make_policies()(1)
    pictures = np.random.default_rng(2).integers(0, 256, (12, 96, 96, 3), dtype=np.uint8)
    wanted = play_theirs(pictures)
    bars = np.array([0.3333, 0, 0])
    for _ in range(2):  # the second episode begins anew
        policy.begin(np.zeros(0, np.float32))
        for picture, output in zip(pictures, wanted, strict=True):
            (worth,), state = policy._run(["worth", "next_state"], {"picture": picture[None], "state": policy._state})
            assert np.abs(worth - bars - output * np.array([0, -1, 1])).max() < 1e-5
            action = policy.act(picture)
            assert action.tolist() == [abs(output) <= 0.3333, output < -0.3333, output > 0.3333]
            assert np.array_equal(policy._state, state)
    assert np.ptp(wanted) > 0.01


def test_a_network_that_wants_to_move_does(file, tmp_path):
    numbers = np.load(file)["params"]
    for bias, wanted in ((9, [0, 0, 1]), (-9, [0, 1, 0]), (0.2, [1, 0, 0])):
        numbers[-17] = bias  # the last layer's bias comes before its weights
        numbers[-16:] = 0
        np.savez(file, params=numbers)
        assert main(["import", str(file), "--out", str(tmp_path / "agent.zip")]) == 0
        policy = make_agent(TrainedAgent.load(tmp_path / "agent.zip")).make_policies()(1)
        assert policy.act(np.zeros((96, 96, 3), np.uint8)).tolist() == wanted


def test_its_folder_is_the_same_agent(file, agent, tmp_path):
    assert main(["import", str(file.parent), "--out", str(tmp_path / "other.zip")]) == 0
    assert (tmp_path / "other.zip").read_bytes() == agent.read_bytes()


def test_evaluate_plays_it_and_equal_games_have_equal_scores(agent, tmp_path, monkeypatch, capsys):
    use_fake(monkeypatch)
    reports = []
    for name in ("a.json", "b.json"):
        out = tmp_path / name
        words = ["--controller", str(agent), "--episodes", "2", "--jobs", "1", "--first-seed", "11000"]
        assert main(["evaluate", *words, "--out", str(out)]) == 0
        reports.append(json.loads(out.read_text()))
        assert main(["evaluate", *words, "--bundle", "tiny"]) == 2  # an agent has no world model
    capsys.readouterr()
    first, second = reports
    assert first["options"] == '{"environment": {"tics": 1}}'
    assert [each["score"] for each in first["drives"]] == [each["score"] for each in second["drives"]]
    assert all(each["score"] >= 40 for each in first["drives"])  # the stand-in's shortest game


def test_it_goes_to_other_processes_and_sees_the_whole_screen(agent, monkeypatch):
    use_fake(monkeypatch)
    found = pickle.loads(pickle.dumps(make_agent(TrainedAgent.load(agent))))
    assert (found.world.horizon, found.truth) == (2100, None)
    environment = found.make_evaluation_environment()
    picture, _ = environment.reset(seed=3)
    assert picture.shape == environment.observation_space.shape == (96, 96, 3)
    assert environment.render().shape == (480, 640, 3)
    environment.close()


def test_it_is_driven_blind_too(agent, monkeypatch):
    use_fake(monkeypatch)
    own = make_agent(TrainedAgent.load(agent))
    pictures = []
    for each in (own, masked(own, "hidden"), masked(own, "foreign")):
        environment = each.make_evaluation_environment()
        pictures.append(environment.reset(seed=7)[0])
        environment.close()
    seen, hidden, foreign = pictures
    assert seen.shape == hidden.shape == foreign.shape
    assert not np.array_equal(seen, hidden)
    assert not np.array_equal(hidden, foreign)


@pytest.mark.parametrize(
    "numbers", [np.zeros(3667, np.float32), np.zeros((3633, 1), np.float32), np.full(3633, np.nan, np.float32),
                np.full(3633, 3e38, np.float32), np.full(3633, 1e300), np.zeros(3633, int)]
)  # fmt: skip
def test_other_weights_are_refused(numbers, tmp_path, capsys):
    np.savez(tmp_path / "model.npz", params=numbers)  # CarRacing's file has 3,667 numbers
    assert main(["import", str(tmp_path / "model.npz"), "--out", str(tmp_path / "x.zip")]) == 1
    assert "model.npz" in capsys.readouterr().err
    assert not (tmp_path / "x.zip").exists()


def test_a_damaged_file_of_its_name_is_no_drive(file, tmp_path, capsys):
    file.write_bytes(file.read_bytes()[:-50])
    for source in (file, file.parent):
        assert find_attention_agent(source) == file
        assert main(["import", str(source), "--out", str(tmp_path / "agent.zip")]) == 1
        assert str(file) in capsys.readouterr().err
    np.savez(tmp_path / "drive.npz", obs=np.zeros((3, 64, 64, 3), np.uint8), action=np.zeros((3, 3)))
    assert find_attention_agent(tmp_path) is None
    assert not (tmp_path / "agent.zip").exists()


def test_the_answer_counts_the_other_files_of_its_folder(file, tmp_path, capsys):
    for number, others in enumerate(("", "drive.npz")):
        (tmp_path / (others or file.name)).write_bytes(file.read_bytes())
        assert main(["import", str(tmp_path), "--out", str(tmp_path / f"{number}.zip"), "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["not_read"] == number


def test_the_advice_on_its_file_works(file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ControllerError) as caught:
        Controller.load(file)
    (command,) = re.findall("`dreamfleet (import [^`]*)`", str(caught.value))
    assert main(shlex.split(command)) == 0
    assert TrainedAgent.load(tmp_path / "OUT").manifest.frame_skip == 1


def test_an_agent_that_its_reader_would_refuse_replaces_nothing(agent):
    before, loaded = agent.read_bytes(), TrainedAgent.load(agent)
    number = np.float32(0.3333).tobytes()
    with pytest.raises(ControllerError):
        replace(loaded, network=loaded.network.replace(number, np.float32(np.nan).tobytes())).save(agent)
    assert agent.read_bytes() == before


def test_the_layout_has_as_many_numbers_as_the_public_file():
    assert parameters(layers()).shape == (SIZE,)
