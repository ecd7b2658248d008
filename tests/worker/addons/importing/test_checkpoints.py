"""World models and controllers in the exact layout of ctallec/world-models, and what people who come from another
project type first: it works, or the answer names the command that does it. Tests sources.py and verb.py."""

import json
import re
import shlex

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.addons.importing.checkpoints import read_mdnrnn, read_vae
from dreamfleet.worker.worldmodel.inference import Decoder, DreamStep
from tests.support import checkpoint_files as theirs


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """Weights, their files, and the bundle and controller made of them."""
    folder, weights = tmp_path_factory.mktemp("exp_dir"), theirs.random_weights()
    theirs.write_checkpoints(folder, weights)
    world, controller = folder / "world.zip", folder / "controller.npz"
    assert main(["import", str(folder), "--out", str(world)]) == 0
    command = ["import", str(folder / "ctrl" / "best.tar"), "--bundle", str(world), "--out", str(controller)]
    assert main(command) == 0
    return folder, weights, Bundle.open(world), Controller.load(controller)


def test_a_controller_acts_as_in_their_program_and_sees_whole_pictures(imported):
    _, weights, bundle, controller = imported
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


def test_the_decoder_draws_their_pictures(imported):
    _, (vae, *_), bundle, _ = imported
    latents = np.random.default_rng(3).normal(0, 1, (3, theirs.LATENT)).astype(np.float32)
    wanted = np.stack([theirs.decode(vae, each.astype(float)) for each in latents]) * 255
    found = Decoder(bundle).decode(latents).astype(float)
    assert np.abs(found - wanted).max() <= 1.5  # its weights have half precision, and it rounds
    assert np.ptp(wanted) > 50


def test_a_dream_draws_all_latents_from_one_gaussian(imported):
    _, (_, rnn, _), bundle, _ = imported
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


def test_old_and_new_files_of_torch_make_the_same_bundle(imported, tmp_path):
    _, weights, bundle, controller = imported
    theirs.write_checkpoints(tmp_path, weights, legacy=True)
    assert main(["import", str(tmp_path), "--out", str(tmp_path / "world.zip")]) == 0
    assert Bundle.open(tmp_path / "world.zip").sha256 == bundle.sha256
    command = ["import", str(tmp_path / "ctrl"), "--bundle", str(tmp_path / "world.zip"), "--out"]
    assert main([*command, str(tmp_path / "c.npz")]) == 0
    assert Controller.load(tmp_path / "c.npz").sha256 == controller.sha256


def test_a_reward_head_that_was_never_trained_is_left_out(imported, tmp_path):
    _, weights, bundle, _ = imported
    assert bundle.manifest.models["mdnrnn"]["reward"] == "value"
    theirs.write_checkpoints(tmp_path, weights, with_reward=False)
    weights, config = read_mdnrnn(tmp_path / "mdrnn" / "best.tar")
    assert config.reward == "none"
    with_head, _ = read_mdnrnn(imported[0] / "mdrnn" / "best.tar")
    assert np.array_equal(weights["heads.bias"], np.delete(with_head["heads.bias"], -2))


def test_a_part_of_another_shape_is_refused(imported, tmp_path):
    vae, rnn, controller = imported[1]
    bad = {**vae, "encoder.conv2.weight": vae["encoder.conv2.weight"][:, :16]}
    theirs.write_checkpoints(tmp_path, (bad, {**rnn, "rnn.bias_hh_l0": rnn["rnn.bias_hh_l0"] * np.nan}, controller))
    with pytest.raises(DatasetError, match=r"\(64, 16, 4, 4\)"):
        read_vae(tmp_path / "vae" / "best.tar")
    with pytest.raises(DatasetError, match="bias_hh"):
        read_mdnrnn(tmp_path / "mdrnn" / "best.tar")
    with pytest.raises(DatasetError, match="VAE"):
        read_vae(tmp_path / "ctrl" / "best.tar")


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


def test_no_file_of_the_source_is_replaced(sources, monkeypatch, capsys):
    monkeypatch.chdir(sources)
    before = (sources / "exp_dir/vae/best.tar").read_bytes()
    assert main(["import", "exp_dir", "--out", "exp_dir/vae/best.tar"]) == 2
    assert main(["import", CTALLEC, "--bundle", "world.zip", "--out", CTALLEC]) == 2
    assert CTALLEC in capsys.readouterr().err
    assert (sources / "exp_dir/vae/best.tar").read_bytes() == before
