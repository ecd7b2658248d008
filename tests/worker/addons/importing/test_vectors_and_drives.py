"""Vectors of parameters, drives, and checkpoints of ctallec/world-models; what people of another project type first.
Tests checkpoints.py, drives.py, sources.py, vectors.py and verb.py."""

import errno
import json
import os
import re
import shlex
import sys
from dataclasses import replace
from pathlib import Path

import cma
import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import ControllerError, DatasetError
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.worker.addons.importing import bundles, drives
from dreamfleet.worker.addons.importing.checkpoints import read_mdnrnn, read_vae
from dreamfleet.worker.addons.importing.drives import read_drive
from dreamfleet.worker.addons.importing.sources import find_checkpoint
from dreamfleet.worker.addons.importing.vectors import read_vector, to_parameters
from dreamfleet.worker.training.data.dataset import episode_paths, find_world, kind_of, load_pictures, load_steps
from dreamfleet.worker.worldmodel.inference import Decoder, DreamStep
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX
from tests.support import checkpoint_files as theirs
from tests.support.samples import SPEC


def test_orders_of_a_vector_that_fits():
    shape = ControllerShape(features=2, actions=3)
    weights, biases = np.arange(6.0).reshape(3, 2), np.array([7.0, 8, 9])
    wanted = [*weights.ravel(), *biases]
    assert to_parameters(np.array(wanted), "dreamfleet", shape).tolist() == wanted
    assert to_parameters(np.array([*biases, *weights.T.ravel()]), "wme", shape).tolist() == wanted
    assert to_parameters(np.array([*weights.T.ravel(), *biases]), "article", shape).tolist() == wanted
    for wrong, layers in ((np.zeros(5), shape), (np.zeros(12), ControllerShape(2, 2, hidden=2))):
        with pytest.raises(ControllerError):
            to_parameters(wrong, "wme", layers)


def test_files_of_vectors(tmp_path):
    vector = np.array([0.5, -1.25, 3.0])
    np.save(tmp_path / "v.npy", vector)
    (tmp_path / "v.csv").write_text("0.5,-1.25,\n3\n")
    (tmp_path / "v.json").write_text(json.dumps([vector.tolist(), 900.0]))
    (tmp_path / "flat.json").write_text(json.dumps(vector.tolist()))
    (tmp_path / "v.txt").write_text("0.5 \n-1.25\n3\n\n")
    (tmp_path / "row.txt").write_text("0.5 -1.25, 3,\n")
    for name in ("v.npy", "v.txt", "row.txt", "v.csv", "v.json", "flat.json"):
        assert read_vector(tmp_path / name).tolist() == vector.tolist()


def test_what_pycma_wrote(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    strategy = cma.CMAEvolutionStrategy([1.0] * 4, 0.5, {"seed": 1, "verbose": -9, "maxiter": 5})
    logger = cma.CMADataLogger("outcmaes/").register(strategy)
    for _ in range(5):
        candidates = strategy.ask()
        strategy.tell(candidates, [float(np.square(each).sum()) for each in candidates])
        logger.add()
    assert read_vector(tmp_path / "outcmaes") == pytest.approx(strategy.mean, rel=1e-4)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("x.csv", "1, two"), ("x.csv", ""), ("x.csv", "1,2\n3\n"), ("x.csv", "1,,2"), ("x.txt", "1 2\n3 4"),
        ("x.txt", "1_0 2 3"), ("x.json", "[[0,0,1],[9,9,9]]"), ("x.json", "[NaN]"), ("x.json", "[1e39]"),
        ("x.json", '{"a": 1}'), ("x.dat", "% nothing"), ("x.dat", "0 0 0 0 0 1_0"), ("x.exe", ""),
        ("x.npy", "no array"), ("x.json", "[1" + "0" * 400 + "]"), ("x.json", '["1"]'),
    ],
)  # fmt: skip
def test_what_is_no_vector_is_refused(name, content, tmp_path):
    (tmp_path / name).write_text(content)
    with pytest.raises(DatasetError, match=name):
        read_vector(tmp_path / name)


def test_a_pickled_array_is_not_executed(tmp_path):
    np.save(tmp_path / "x.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(DatasetError):
        read_vector(tmp_path / "x.npy")


@pytest.mark.parametrize("name", ["v.json", "v.npy"])
@pytest.mark.parametrize("optimiser", ["external", "cma"])
def test_a_vector_like_a_run_lies_as_the_runs_own_and_needs_no_torch(name, optimiser, tmp_path, monkeypatch):
    spec = replace(SPEC, task="gym:CartPole-v1", bundle="", options='{"x": 1}', controller=ControllerShape(4, 2))
    settings = RunSettings(spec, ControllerShape(4, 2), 4, 1, 0.1, "diagonal", 1, 0, 1, optimiser=optimiser)
    (tmp_path / "mine").mkdir()
    Journal.create(tmp_path / "mine", settings, None).close()
    vector = [float(each) for each in range(10)]
    (tmp_path / "v.json").write_text(json.dumps(vector))
    np.save(tmp_path / "v.npy", vector)
    monkeypatch.setitem(sys.modules, "torch", None)  # not installed
    monkeypatch.delitem(sys.modules, "dreamfleet.worker.addons.importing.checkpoints", raising=False)
    words = ["--like", "mine", "--runs-dir", str(tmp_path), "--out", str(tmp_path / "best.npz")]
    assert main(["import", str(tmp_path / name), *words]) == 0
    found = Controller.load(tmp_path / "best.npz")
    assert (found.parameters.tolist(), found.task, found.options) == (vector, spec.task, spec.options)
    assert main(["import", str(tmp_path / name), *words, "--layout", "wme"]) == 0
    assert Controller.load(tmp_path / "best.npz").parameters.tolist() == [2, 4, 6, 8, 3, 5, 7, 9, 0, 1]


@pytest.mark.parametrize(
    ("name", "code", "named"),
    [("v.npy", 2, "--like"), ("weights.h5", 1, "weights.h5"), ("controller.pkl", 1, "controller.pkl")],
)
def test_a_vector_alone_and_what_cannot_be_read_are_refused_with_the_reason(name, code, named, tmp_path, capsys):
    if name == "v.npy":
        np.save(tmp_path / name, np.zeros(867))
    else:
        (tmp_path / name).write_bytes(b"\x80\x04cos\nsystem\n")
    assert main(["import", str(tmp_path / name), "--out", str(tmp_path / "x.npz")]) == code
    assert named in capsys.readouterr().err


def take_in(source, out):
    return main(["import", str(source), "--out", str(out)])


@pytest.fixture
def imported(tmp_path):
    """Import two drives of these arrays; the first one."""

    def first(**arrays):
        source = tmp_path / "source"
        source.mkdir()
        for number in range(2):
            np.savez_compressed(source / f"{number}.npz", **arrays)
        assert take_in(source, tmp_path / "data") == 0
        return episode_paths(tmp_path / "data")[0]

    return first


def test_drives_of_wme(imported):
    pictures = np.random.default_rng(1).integers(0, 256, (6, 64, 64, 3), dtype=np.uint8)
    first = imported(obs=pictures, action=np.zeros((6, 3), np.float16))
    assert np.array_equal(load_pictures(first), pictures + np.uint8(1))
    assert load_steps(first)["reward"].tolist() == [0] * 6


SEEN, STILL = np.zeros((3, 64, 64, 3), np.uint8), np.zeros((3, 3))
PROGRAMS = {
    # hardmaru/WorldModelsExperiments, carracing/extract.py: white is 254 there, and black 255
    "wme": ("1466665.npz", 254, {"obs": np.uint8, "action": np.float16}),
    # zacwellmer/WorldModels, WorldModels/extract.py
    "dreamfleet": ("1001466665.npz", 255, {"obs": np.uint8, "action": np.float16, "reward": np.float16, "done": bool,
                                           "N": np.uint16}),
    # ctallec/world-models, data/carracing.py
    "ctallec": ("rollout_0.npz", 255, {"observations": np.uint8, "actions": np.float32, "rewards": float,
                                       "terminals": bool}),
    # AppliedDataSciencePartners/WorldModels, 01_generate_data.py
    "article": ("735.npz", 1.0, {"obs": np.float32, "action": np.float32, "reward": float, "done": bool}),
}  # fmt: skip


@pytest.mark.parametrize("layout", PROGRAMS)
def test_white_stays_white_in_the_drives_of_each_public_program(layout, tmp_path):
    name, white, types = PROGRAMS[layout]
    shapes = {"obs": (4, 64, 64, 3), "observations": (4, 96, 96, 3), "action": (4, 3), "actions": (4, 3)}
    arrays = {each: np.zeros(shapes.get(each, 4), kind) for each, kind in types.items()}
    arrays["obs" if "obs" in types else "observations"][:] = white
    if layout == "article":
        arrays["reward"][0] = -0.1
    np.savez_compressed(tmp_path / name, **arrays)
    drive = read_drive(tmp_path / name)
    assert drive.layout == layout
    assert (drive.arrays["picture"] == 255).all()


@pytest.mark.parametrize(
    ("white", "pictures", "actions"),
    [(1.0, np.float32, np.float16), (255, np.float32, np.float16), (255, np.int64, np.float16),
     (255, np.uint8, np.float32), (1.0, float, float)],
)  # fmt: skip
def test_drives_without_rewards_are_not_wmes_by_that_alone(white, pictures, actions, tmp_path):
    arrays = {"obs": np.full((3, 64, 64, 3), white, pictures), "action": np.zeros((3, 3), actions)}
    np.savez(tmp_path / "x.npz", **arrays)
    drive = read_drive(tmp_path / "x.npz")
    assert (drive.layout, drive.has_rewards) == ("dreamfleet", False)
    assert (drive.arrays["picture"] == 255).all()


def test_named_as_wmes_pictures_must_be_what_that_program_writes(tmp_path):
    arrays = {"obs": np.ones((3, 64, 64, 3)), "action": np.zeros((3, 3))}
    np.savez(tmp_path / "x.npz", **arrays)
    with pytest.raises(DatasetError):
        read_drive(tmp_path / "x.npz", layout="wme")
    np.savez(tmp_path / "x.npz", **arrays | {"obs": np.full((3, 64, 64, 3), 254, np.uint8)})
    assert (read_drive(tmp_path / "x.npz", layout="wme").arrays["picture"] == 255).all()


@pytest.mark.parametrize(
    "names", [("obs", "action", "reward", "done"), ("observations", "actions", "rewards", "terminals")]
)
def test_drives_with_rewards_and_ends(names, imported):
    pictures = np.random.default_rng(1).random((5, 64, 64, 3)).astype(np.float32)
    arrays = (pictures, np.zeros((5, 3)), np.arange(5.0), np.arange(5) == 4)
    first = imported(**dict(zip(names, arrays, strict=True)))
    assert np.array_equal(load_pictures(first), np.round(pictures * 255).astype(np.uint8))
    steps = load_steps(first)
    assert (steps["reward"].tolist(), bool(steps["ended"])) == ([0, 1, 2, 3, 4], True)


def test_whole_observations_are_cut_and_shrunk(imported):
    whole = np.random.default_rng(1).integers(0, 256, (3, 96, 96, 3), dtype=np.uint8)
    first = imported(
        observations=whole, actions=np.zeros((3, 3)), rewards=np.zeros(3), terminals=np.zeros(3, bool)
    )  # fmt: skip
    assert np.array_equal(load_pictures(first), [BOX.picture(each) for each in whole])


@pytest.mark.parametrize(
    "arrays",
    [
        {"obs": SEEN},
        {"obs": np.zeros((3, 32, 32, 3), np.uint8), "action": STILL},
        {"obs": SEEN, "action": np.zeros((2, 3))},
        {"obs": np.full((3, 64, 64, 3), np.nan), "action": STILL},
        {"obs": SEEN, "action": np.full((3, 3), np.inf)},
        {"obs": np.array([{}], object), "action": STILL},
        {"obs": SEEN, "action": np.full((3, 3), "left")},
        {"obs": np.full((3, 64, 64, 3), 300), "action": STILL},
        {"obs": SEEN, "action": STILL, "done": np.full(3, np.nan)},
        {"obs": np.zeros((30_000, 64, 64, 3), np.uint8), "action": np.zeros((30_000, 3))},
    ],
)
def test_what_is_no_drive_is_refused(arrays, tmp_path, capsys):
    np.savez(tmp_path / "x.npz", **arrays)
    assert take_in(tmp_path / "x.npz", tmp_path / "data") == 1
    assert "x.npz" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


def test_a_folder_with_drives_is_not_added_to(imported, tmp_path, capsys):
    imported(obs=SEEN, action=STILL)
    assert take_in(tmp_path / "source", tmp_path / "data") == 2
    assert "--out" in capsys.readouterr().err


def test_the_writer_of_the_page_makes_a_data_set(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parents[4] / "docs" / "reference" / "import.md").read_text()
    exec(page.split("```python\n")[1].split("```")[0], {})
    assert main(["import", "drives", "--out", "data"]) == 0
    assert len(load_pictures(episode_paths(Path("data"))[0])) == 20


@pytest.mark.parametrize("size", [64, 96])
def test_drives_of_ctallec_are_shifted_by_a_step(size, tmp_path, capsys):
    source = tmp_path / "carracing"
    first, _ = (theirs.write_drive(source / f"thread_{each}", each, size=size) for each in range(2))
    assert take_in(source, tmp_path / "data") == 0
    assert "ctallec" in capsys.readouterr().out
    path = episode_paths(tmp_path / "data")[0]
    whole = find_world().preprocessings["whole-64"]
    pictures = [whole.picture(each) if size == 96 else each for each in first["observations"]]
    assert np.array_equal(load_pictures(path), pictures[:-1])
    steps = load_steps(path)
    assert np.array_equal(steps["action"], first["actions"][1:6].astype(np.float32))
    assert np.array_equal(steps["reward"], first["rewards"][1:].astype(np.float32))
    assert bool(steps["ended"])


def test_drives_of_the_article_have_the_reward_of_the_step_before(imported, capsys):
    random, reward = np.random.default_rng(1), np.array([-0.1, 7.0, -0.1, 3.0, -0.1])
    pictures, action = random.integers(0, 256, (5, 64, 64, 3)).astype(np.float32) / 255, random.random((5, 3))
    path = imported(obs=pictures, action=action, reward=reward, done=np.arange(5) == 4)
    assert "article" in capsys.readouterr().out
    assert kind_of(path)[1] == "whole-64"
    assert np.array_equal(load_pictures(path), np.round(pictures[:-1] * 255).astype(np.uint8))
    steps = load_steps(path)
    assert np.array_equal(steps["reward"], reward[1:].astype(np.float32))
    assert np.array_equal(steps["action"], action[:-1].astype(np.float32))


def test_one_drive_is_no_drives(tmp_path):
    np.savez(tmp_path / "x.npz", obs=np.zeros((1, 64, 64, 3)), action=np.zeros((1, 3)))
    assert take_in(tmp_path / "x.npz", tmp_path / "data") == 0
    (path,) = (tmp_path / "data" / "episodes").glob("*.npz")
    assert len(load_pictures(path)) == 1


def test_a_layout_may_be_named(tmp_path):
    np.savez(tmp_path / "x.npz", **theirs.write_drive(tmp_path / "thread_0", 0))
    with pytest.raises(DatasetError):
        read_drive(tmp_path / "x.npz")
    assert len(read_drive(tmp_path / "x.npz", layout="ctallec").arrays["picture"]) == 5


@pytest.mark.slow
def test_a_world_model_is_trained_on_drives_of_ctallec(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for each in range(3):
        theirs.write_drive(tmp_path / "carracing" / "thread_0", each, steps=30)
    assert main(["import", "carracing", "--out", "data"]) == 0
    few = ["--preset", "paper", "--updates", "2"]
    assert main(["train", "vae", "--data", "data", *few]) == 0
    assert main(["encode", "--data", "data"]) == 0
    assert "mirrored_mu" not in np.load(episode_paths(Path("data"), "encoded")[0]).files
    assert main(["train", "mdnrnn", "--data", "data", "--set", "joint=true", "done=true", *few]) == 0
    assert main(["bundle", "--data", "data", "--out", "world.zip"]) == 0
    assert Bundle.open(Path("world.zip")).manifest.preprocessing == "whole-64"


@pytest.fixture(scope="module")
def taken_in(tmp_path_factory):
    """Weights, their files, and the bundle and controller made of them."""
    folder, weights = tmp_path_factory.mktemp("exp_dir"), theirs.random_weights()
    theirs.write_checkpoints(folder, weights)
    world, controller = folder / "world.zip", folder / "controller.npz"
    assert main(["import", str(folder), "--out", str(world)]) == 0
    command = ["import", str(folder / "ctrl" / "best.tar"), "--bundle", str(world), "--out", str(controller)]
    assert main(command) == 0
    return folder, weights, Bundle.open(world), Controller.load(controller)


def test_a_controller_acts_as_in_their_program_and_sees_whole_pictures(taken_in):
    _, weights, bundle, controller = taken_in
    assert (bundle.manifest.preprocessing, bundle.manifest.picture) == ("whole-64", (64, 64, 3))
    assert controller.variant.actions == "linear"
    pictures = np.random.default_rng(2).integers(0, 256, (20, 64, 64, 3), dtype=np.uint8)
    wanted = theirs.drive(weights, pictures)
    state, actions = None, []
    for each in pictures:
        action, state = controller.predict(each, state, bundle=bundle)
        actions.append(action)
    assert np.abs(np.array(actions) - wanted).max() < 1e-5
    assert np.ptp(wanted, axis=0).min() > 0.1
    assert np.abs(wanted).max() > 1  # beyond what the car does: the LSTM sees it as it is


def test_the_decoder_draws_their_pictures(taken_in):
    _, (vae, *_), bundle, _ = taken_in
    latents = np.random.default_rng(3).normal(0, 1, (3, theirs.LATENT)).astype(np.float32)
    wanted = np.stack([theirs.decode(vae, each.astype(float)) for each in latents]) * 255
    found = Decoder(bundle).decode(latents).astype(float)
    assert np.abs(found - wanted).max() <= 1.5  # its weights have half precision, and it rounds
    assert np.ptp(wanted) > 50


def test_a_dream_draws_all_latents_from_one_gaussian(taken_in):
    _, (_, rnn, _), bundle, _ = taken_in
    step, random = DreamStep(bundle), np.random.default_rng(4)
    latent = random.normal(0, 1, (40, theirs.LATENT)).astype(np.float32)
    action = random.normal(0, 1, (40, 3)).astype(np.float32)
    uniform, normal = random.random((2, 40, theirs.LATENT), dtype=np.float32)
    found = step.imagine(latent, action, step.zero_state(40), uniform, normal, 1.0)
    chosen = []
    for row in range(40):
        means, spreads, logits, reward, end = theirs.Memory(rnn).advance(
            action[row].astype(float), latent[row].astype(float)
        )
        weights = np.exp(logits - logits.max())
        gaussian = int(np.searchsorted(np.cumsum(weights / weights.sum()), uniform[row, 0], side="right"))
        wanted = means[gaussian] + spreads[gaussian] * normal[row]
        assert np.abs(found.latent[row] - wanted).max() < 5e-3  # heads have half precision
        assert found.reward[row] == pytest.approx(reward, abs=5e-3)
        assert found.done[row] == pytest.approx(theirs.sigmoid(end), abs=5e-3)
        chosen.append(gaussian)
    assert len(set(chosen)) == theirs.MIXTURES


def test_old_and_new_files_of_torch_make_the_same_bundle(taken_in, tmp_path):
    _, weights, bundle, controller = taken_in
    theirs.write_checkpoints(tmp_path, weights, legacy=True)
    assert main(["import", str(tmp_path), "--out", str(tmp_path / "world.zip")]) == 0
    assert Bundle.open(tmp_path / "world.zip").sha256 == bundle.sha256
    command = ["import", str(tmp_path / "ctrl"), "--bundle", str(tmp_path / "world.zip"), "--out"]
    assert main([*command, str(tmp_path / "c.npz")]) == 0
    assert Controller.load(tmp_path / "c.npz").sha256 == controller.sha256


def test_a_reward_head_that_was_never_trained_is_left_out(taken_in, tmp_path):
    _, weights, bundle, _ = taken_in
    assert bundle.manifest.models["mdnrnn"]["reward"] == "value"
    theirs.write_checkpoints(tmp_path, weights, with_reward=False)
    weights, config = read_mdnrnn(tmp_path / "mdrnn" / "best.tar")
    assert config.reward == "none"
    with_head, _ = read_mdnrnn(taken_in[0] / "mdrnn" / "best.tar")
    assert np.array_equal(weights["heads.bias"], np.delete(with_head["heads.bias"], -2))


def test_a_part_of_another_shape_is_refused(taken_in, tmp_path):
    vae, rnn, controller = taken_in[1]
    bad = {**vae, "encoder.conv2.weight": vae["encoder.conv2.weight"][:, :16]}
    theirs.write_checkpoints(tmp_path, (bad, {**rnn, "rnn.bias_hh_l0": rnn["rnn.bias_hh_l0"] * np.nan}, controller))
    with pytest.raises(DatasetError, match=r"\(64, 16, 4, 4\)"):
        read_vae(tmp_path / "vae" / "best.tar")
    with pytest.raises(DatasetError, match="bias_hh"):
        read_mdnrnn(tmp_path / "mdrnn" / "best.tar")
    with pytest.raises(DatasetError, match="VAE"):
        read_vae(tmp_path / "ctrl" / "best.tar")


def test_biases_whose_sum_is_infinite_are_refused(taken_in, tmp_path):
    vae, rnn, controller = taken_in[1]
    large = {f"rnn.bias_{each}_l0": np.full_like(rnn[f"rnn.bias_{each}_l0"], 3e38) for each in ("ih", "hh")}
    theirs.write_checkpoints(tmp_path, (vae, {**rnn, **large}, controller))
    with pytest.raises(DatasetError, match="bias_ih"):
        read_mdnrnn(tmp_path / "mdrnn" / "best.tar")


def test_a_checkpoint_that_cannot_be_read_is_not_left_out(tmp_path):
    (tmp_path / "vae" / "best.tar").mkdir(parents=True)
    (tmp_path / "vae" / "checkpoint.tar").touch()
    assert find_checkpoint(tmp_path, "vae") == tmp_path / "vae" / "best.tar"


WME, ARTICLE, CTALLEC = "log/best.json", "controller/car_racing.cma.4.32.best.json", "exp_dir/ctrl/best.tar"
DRIVES = ("record", "rollout", "datasets/carracing")
TRAIN = "train vae --data data --preset paper"
# What is typed, its exit code, and the command that the answer names, or "" where it is the result.
TYPED = [
    *((typed.format(source), 1, f"import {source} --bundle WORLD_MODEL --out controller.npz") for source, typed in (
        *((source, "evaluate --controller {}") for source in (WME, ARTICLE, CTALLEC)),
        (WME, "record --controller {} --out x.mp4"),
        (WME, "coordinator --run x --init {}"),
        (CTALLEC, "coordinator --run x --init {}"),
        (WME, "lab refit {} --to tiny --data data --out x.npz"),
    )),
    *((f"train vae --data {source}", 1, f"import {source} --out DATA") for source in DRIVES),
    *((f"import {source} --out data", 0, TRAIN) for source in DRIVES),
    (f"import {WME} --out x.npz", 2, "import FOLDER --out world.zip"),
    (f"import {WME} --bundle world.zip --out x.npz", 0, ""),
    (f"import {ARTICLE} --layout article --bundle world.zip --out x.npz", 0, ""),
    ("import vae/weights.h5 --out x.zip", 1, "import DRIVES --out DATA"),
    ("import . --out x.zip", 1, "import DRIVES --out DATA"),
    ("evaluate --controller exp_dir", 1, "import exp_dir --out OUT"),
    ("evaluate --controller tiny --bundle exp_dir/vae/best.tar", 1, "import exp_dir --out world.zip"),
    (f"import {CTALLEC} --out x.npz", 2, "import exp_dir --out world.zip"),
    ("import exp_dir/vae/best.tar --out x.zip", 1, "import exp_dir --out world.zip"),
    ("coordinator --run x --task dream --bundle exp_dir", 1, "import exp_dir --out world.zip"),
    ("import exp_dir --out world.zip", 0, f"import {CTALLEC} --bundle world.zip --out controller.npz"),
    (f"import {CTALLEC} --bundle world.zip --out x.npz", 0, "evaluate --controller x.npz --bundle world.zip"),
    ("import exp_dir/ctrl --bundle world.zip --out x.npz", 0, "evaluate --controller x.npz --bundle world.zip"),
]  # fmt: skip


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """A folder with the files that the three programs write, and a world model `world.zip`."""
    folder = tmp_path_factory.mktemp("sources")
    theirs.write_checkpoints(folder / "exp_dir", theirs.random_weights())
    assert main(["import", str(folder / "exp_dir"), "--out", str(folder / "world.zip")]) == 0
    for place in (WME, ARTICLE):
        (folder / place).parent.mkdir()
        (folder / place).write_text(json.dumps([np.linspace(-0.2, 0.2, 867).round(4).tolist(), 903.5]))
    pictures = np.zeros((3, 64, 64, 3), np.uint8)
    drives = {
        "record": {"obs": pictures, "action": np.zeros((3, 3), np.float16)},
        "rollout": {
            "obs": pictures / np.float32(255), "action": np.zeros((3, 3)), "reward": np.array([-0.1, 7, -0.1]),
            "done": np.zeros(3, bool),
        },
    }  # fmt: skip
    for place, arrays in drives.items():
        (folder / place).mkdir()
        for number in (1520837, 934721):
            np.savez_compressed(folder / place / f"{number}.npz", **arrays)
    for number in range(2):
        theirs.write_drive(folder / "datasets" / "carracing" / f"thread_{number}", number)
    for part in ("vae", "rnn"):
        (folder / part).mkdir()
        (folder / part / "weights.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    return folder


@pytest.mark.parametrize(("typed", "code", "named"), TYPED)
def test_a_first_command_ends_in_its_result_or_names_the_command(
    typed, code, named, sources, tmp_path, monkeypatch, capsys
):
    for path in sources.iterdir():
        (tmp_path / path.name).symlink_to(path)
    if "--out world.zip" in typed:
        (tmp_path / "world.zip").unlink()
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(typed)) == code
    answer = "".join(capsys.readouterr())
    assert f"`dreamfleet {named}" in answer
    assert "Traceback" not in answer
    if code and not {"FOLDER", "DRIVES", "OUT"} & set(named.split()):  # what it names does it
        command = re.search(r"`dreamfleet (import [^`]*)`", answer)[1]
        assert main(shlex.split(command.replace("WORLD_MODEL", "world.zip").replace("--out world", "--out again"))) == 0
        assert written_by(command.split()[-1].replace("world", "again"), tmp_path)


def written_by(name, folder):
    """What a command wrote, opened as its next user opens it."""
    path = folder / name
    if name.endswith(".npz"):
        return Controller.load(path).shape.size == 867
    return Bundle.open(path).manifest.latent == 32 if name.endswith(".zip") else any((path / "episodes").iterdir())


@pytest.mark.parametrize(
    ("source", "flags"), [("exp_dir", ("layout", "bundle", "like")), ("agent.npz", ("layout", "bundle", "like")),
                          ("record", ("bundle", "like"))]
)  # fmt: skip
def test_flags_that_a_source_does_not_have_are_refused(source, flags, sources, tmp_path, capsys):
    np.savez(sources / "agent.npz", params=np.zeros(3))
    for flag in flags:
        value = "wme" if flag == "layout" else "tiny"
        assert main(["import", str(sources / source), f"--{flag}", value, "--out", str(tmp_path / "x")]) == 2
        assert f"--{flag}" in capsys.readouterr().err
        assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("module", "writer", "source"), [(bundles, "write_bundle", "exp_dir"), (drives, "write_episode", "record")]
)
def test_a_disk_that_is_full_asks_for_another_out(module, writer, source, sources, tmp_path, monkeypatch, capsys):
    def fail(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(module, writer, fail)
    assert take_in(sources / source, tmp_path / "x") == 1
    answer = capsys.readouterr().err
    assert "--out" in answer
    assert "--new" not in answer


def test_no_file_of_the_source_is_replaced(sources, monkeypatch, capsys):
    monkeypatch.chdir(sources)
    before = (sources / "exp_dir/vae/best.tar").read_bytes()
    assert main(["import", "exp_dir", "--out", "exp_dir/vae/best.tar"]) == 2
    assert main(["import", CTALLEC, "--bundle", "world.zip", "--out", CTALLEC]) == 2
    assert CTALLEC in capsys.readouterr().err
    assert (sources / "exp_dir/vae/best.tar").read_bytes() == before
