"""The files of a data set, whole, damaged in thousands of ways, or of another kind; states that it recorded.
Tests recorded_states.py, worker/training/stages/bundle.py and worker/addons/bundles/verb.py."""

import itertools
import json
import shutil

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import RECORDED_STATES, Bundle
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.worker.addons.bundles import verb as verbs
from dreamfleet.worker.addons.inspection.page_builder import manifest_facts
from dreamfleet.worker.training import train_mdnrnn
from dreamfleet.worker.training.assemble import assemble
from dreamfleet.worker.training.data.collect import collect, import_rollouts
from dreamfleet.worker.training.data.collect_config import CollectConfig
from dreamfleet.worker.training.data.dataset import (
    check_whole,
    episode_paths,
    load_arrays,
    load_pictures,
    load_steps,
    pad,
    picture_batches,
    split_held_out,
)
from dreamfleet.worker.training.data.rollout_batches import load_rollouts
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel.inference import DreamStep, RewardLabel
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.drives import ignore, train_models, write_drive, write_drives, write_encoded
from tests.support.mutations import Watched, archives
from tests.support.verbs import run_verb

NAMES = ("picture", "action", "reward", "preprocessing")
DAMAGES = 1000


@pytest.mark.parametrize("kind", ["episodes", "encoded"])
def test_an_empty_folder_is_refused_with_the_verb_that_fills_it(tmp_path, kind):
    with pytest.raises(DatasetError, match="collect" if kind == "episodes" else "encode"):
        episode_paths(tmp_path, kind)


def test_one_episode_is_too_few_to_hold_any_out(tmp_path):
    write_drive(tmp_path, 0)
    with pytest.raises(DatasetError):
        episode_paths(tmp_path)


def test_files_of_an_unfinished_write_are_no_episodes(tmp_path):
    paths = write_drives(tmp_path)
    (tmp_path / "episodes" / ".000099.npz.1.part").write_bytes(b"half")
    assert episode_paths(tmp_path) == paths


def test_whole_episodes_are_held_out(tmp_path):
    paths = [tmp_path / f"{number:06d}.npz" for number in range(45)]
    train, held_out = split_held_out(paths)
    assert sorted(train + held_out) == paths
    assert held_out == [paths[0], paths[20], paths[40]]


@pytest.fixture
def watched():
    made = Watched()
    yield made
    made.check()


@pytest.mark.slow
def test_damaged_drives_are_read_or_refused_in_one_line(tmp_path, watched):
    def read():
        check_whole([path], "picture", "action")
        assert len(load_pictures(path)) > 0
        assert len(load_steps(path)["reward"]) > 0
        load_arrays(path, "driver")

    path, count = write_drive(tmp_path, 0, steps=3), 0
    for data in archives(path.read_bytes(), DAMAGES, seed=6):
        path.write_bytes(data)
        count += watched.read(DatasetError, read)
    assert 0 < count < DAMAGES


def test_damaged_encoded_drives_are_read_or_refused_in_one_line(tmp_path, watched):
    (path,), count = write_encoded(tmp_path, np.zeros((1, 5)), ended=True), 0
    for data in archives(path.read_bytes(), DAMAGES, seed=7):
        path.write_bytes(data)
        count += watched.read(DatasetError, lambda: load_rollouts([path]))
    assert 0 < count < DAMAGES


def test_what_is_read_of_a_damaged_drive_is_whole(tmp_path):
    path = write_drive(tmp_path, 0, steps=2)
    whole, data = load_arrays(path, *NAMES), path.read_bytes()
    for position in range(0, len(data), 13):
        damaged = bytearray(data)
        damaged[position] ^= 0xFF
        path.write_bytes(damaged)
        try:
            found = load_arrays(path, *NAMES)
        except DatasetError:
            continue
        assert all(np.array_equal(found[name], whole[name]) for name in NAMES), position


@pytest.mark.parametrize(
    "changed",
    [
        {"picture": np.zeros((4, 64, 64, 3), np.float32)},
        {"picture": np.zeros((4, 32, 64, 3), np.uint8)},
        {"picture": np.zeros((), np.uint8)},
        {"picture": np.zeros((5, 64, 64, 3), np.uint8)},
        {"action": np.zeros((4, 3), np.int64)},
        {"action": np.zeros(4, np.float32)},
        {"action": np.zeros((3, 3), np.float32)},
        {"action": np.array([["a"] * 3] * 4)},
        {"reward": np.zeros((4, 1), np.float32)},
        {"reward": np.zeros(0, np.float32)},
        {"ended": np.zeros(4, bool)},
        {"ended": np.array("yes")},
        {"preprocessing": np.zeros(3)},
        None,
    ],
)
def test_a_drive_of_another_kind_is_never_taken_in(tmp_path, changed):
    path = write_drive(tmp_path / "sent", 0, steps=4)
    if changed is None:
        path.write_bytes(b"no drive")
    else:
        np.savez(path, **{**np.load(path), **changed})
    with pytest.raises(DatasetError, match=str(path)):
        list(import_rollouts(tmp_path / "data", [path]))
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    "changes",
    [
        {"preprocessing": np.array("bilinear-64")},
        {"pictures": np.zeros((4, 96, 96, 3), np.uint8)},
        {"pictures": np.zeros((0, 64, 64, 3), np.uint8)},
    ],
)
def test_pictures_of_another_kind_are_refused(tmp_path, changes):
    with pytest.raises(DatasetError):
        load_pictures(write_drive(tmp_path, 0, **changes))


@pytest.mark.parametrize(("there", "wanted"), [(64, 96), (96, 64)])
def test_no_folder_gets_two_kinds_of_pictures(tmp_path, there, wanted):
    path = write_drive(tmp_path, 7, picture=there)
    with pytest.raises(DatasetError, match=rf"{path.name}.*{there}.*{wanted}"):
        list(collect(tmp_path, CollectConfig(episodes=3, steps=8, picture=wanted), jobs=1))
    other = write_drive(tmp_path / "run", 0, picture=wanted)
    for folder, rollouts in ((tmp_path, [other]), (tmp_path / "new", [path, other])):
        with pytest.raises(DatasetError):
            list(import_rollouts(folder, rollouts))
    assert not (tmp_path / "new").exists()
    assert [each.name for each in (tmp_path / "episodes").iterdir()] == [path.name]


@pytest.fixture
def paths(tmp_path):
    return write_drives(tmp_path)


def test_batches_are_a_pure_function_of_seed_and_pool_and_go_on_behind_any_of_them(paths):
    batches = list(itertools.islice(picture_batches(paths, 16, 0), 9))
    for index, (pool, taken, _) in enumerate(batches[:-1]):
        behind = next(picture_batches(paths, 16, 0, pool, taken))
        assert behind[:2] == batches[index + 1][:2]
        assert np.array_equal(behind[2], batches[index + 1][2])
    first = batches[0][2]
    assert np.array_equal(first, next(picture_batches(paths, 16, 0, 0))[2])
    for seed, pool in ((1, 0), (0, 1)):
        assert not np.array_equal(first, next(picture_batches(paths, 16, seed, pool))[2])


def test_a_pool_shows_no_picture_twice(paths):
    batches = itertools.takewhile(lambda each: each[0] == 0, picture_batches(paths, 16, seed=0))
    pictures = np.concatenate([batch for _, _, batch in batches])
    assert len(np.unique(pictures.reshape(len(pictures), -1), axis=0)) == len(pictures)


def test_fewer_pictures_than_a_batch_make_a_smaller_batch(tmp_path):
    paths = write_drives(tmp_path, episodes=2, steps=3)
    assert [len(batch) for _, _, batch in itertools.islice(picture_batches(paths, 100, seed=0), 2)] == [5, 5]


def test_memory_holds_a_pool_and_not_the_data_set(paths, monkeypatch):
    module, loaded = "dreamfleet.worker.training.data.dataset", []
    monkeypatch.setattr(f"{module}.POOL_EPISODES", 2)
    monkeypatch.setattr(f"{module}.load_pictures", lambda path: loaded.append(path) or load_pictures(path))
    next(picture_batches(paths, 4, seed=0))
    assert len(loaded) == 2


def test_padding_is_zero_behind_the_end():
    padded = pad([np.ones((2, 3), np.float32), np.ones((4, 3), np.float32)])
    assert padded.shape == (2, 4, 3)
    assert padded.sum(axis=(1, 2)).tolist() == [6, 12]
    assert not padded[0, 2:].any()


SHORT = TrainConfig(updates=1, batch=4, rate=1e-3)
LATENT, HIDDEN = 3, 4
STEPS = 90
MODELS = {
    name: MDNRNNConfig(latent=LATENT, hidden=HIDDEN, **more)
    for name, more in {
        "plain": {},
        "rewarded": {"previous_reward": True},
        "value": {"reward": "value", "previous_reward": True, "dropout": 0.2},
        "attentive": {"window": 3, "attention_units": 4},
    }.items()
}


@pytest.fixture(scope="module")
def encoded(tmp_path_factory):
    """Drives, each second one without a reward from step 40 on."""
    folder = tmp_path_factory.mktemp("data")
    drives = [write_drive(folder, number, STEPS - number) for number in range(4)]
    train_models(folder, SHORT, VAEConfig(latent=LATENT, channels=(2, 2, 2, 2)))
    for number, path in enumerate(drives):
        random, shape = np.random.default_rng(number), (STEPS - number, LATENT)
        reward = load_arrays(path, "reward")["reward"]
        reward[40 if number % 2 else STEPS :] = -0.1
        # One update sees the same in every picture.
        mu, logvar = (random.normal(size=shape).astype(np.float32) for _ in range(2))
        encoded = folder / "encoded" / path.name
        np.savez(encoded, **{**np.load(encoded), "reward": reward, "mu": mu, "logvar": logvar})
    return folder


@pytest.fixture
def trained(encoded, tmp_path):
    """A folder with these drives and a trained MDN-RNN."""

    def folder(name):
        made = shutil.copytree(encoded, tmp_path / "data")
        train_mdnrnn.train_mdnrnn(made, SHORT, ignore, MODELS[name])
        return made

    return folder


def remembered(bundle, folder):
    """The latents of each step of each drive, and the state before it by the bundle's graphs, keyed by the latents."""
    model, label, found = DreamStep(bundle), RewardLabel(bundle), {}
    for path in sorted((folder / "encoded").iterdir()):
        arrays = load_arrays(path, "mu", "logvar", "action", "reward")
        state = model.zero_state(1)
        for step, mu in enumerate(arrays["mu"]):
            key = np.concatenate([mu, arrays["logvar"][step]])
            found[key.astype(np.float16).tobytes()] = (path.stem, step, np.concatenate([key, state[0]]))
            state = model.advance(mu[None], arrays["action"][step : step + 1], state)
            label.write(state, arrays["reward"][step : step + 1])
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_a_recorded_state_is_what_a_drive_up_to_there_remembers(trained, tmp_path, name):
    folder = trained(name)
    bundle = assemble(folder, tmp_path / "b.zip", "b", with_weights=False, recorded=40)
    states, places = bundle.read_recorded(), remembered(bundle, folder)
    assert states.shape == (40, 2 * LATENT + MODELS[name].state)
    at = [places[state[: 2 * LATENT].astype(np.float16).tobytes()] for state in states]
    assert len({place[:2] for place in at}) == 40
    assert min(step for _, step, _ in at) >= 20
    np.testing.assert_allclose(states, [place for *_, place in at], rtol=1e-3, atol=1e-5)
    assert bundle.manifest.provenance["recorded"] == {"states": 40, "before_losses": 2}


def test_equal_folders_record_equal_states_and_none_are_the_bundle_of_before(trained, tmp_path):
    folder = trained("plain")
    first, again, none, before = (
        assemble(folder, tmp_path / f"{number}.zip", "b", with_weights=False, **more)
        for number, more in enumerate(({"recorded": 30}, {"recorded": 30}, {"recorded": 0}, {}))
    )
    assert (first.sha256, first.recorded_count) == (again.sha256, 30)
    assert (none.sha256, none.recorded_count) == (before.sha256, 0)
    assert RECORDED_STATES not in none.manifest.parts
    assert "recorded" not in none.manifest.provenance


def call(capsys, folder, *flags):
    assert run_verb(verbs, "--data", folder, "--out", folder / "b.zip", *flags) == 0
    return capsys.readouterr().out


def test_the_verb_and_the_page_show_how_many_there_are(trained, capsys):
    folder = trained("plain")
    every = sum(STEPS - number - 20 for number in range(4))
    assert json.loads(call(capsys, folder, "--json"))["recorded"] == every < 512
    assert dict(manifest_facts(Bundle.open(folder / "b.zip")))["recorded states"] == str(every)
    for count in (7, 0):
        assert json.loads(call(capsys, folder, "--recorded", str(count), "--json"))["recorded"] == count
    assert dict(manifest_facts(Bundle.open(folder / "b.zip")))["recorded states"] == "none"
    for wrong in ("-1", "16385"):
        with pytest.raises(UsageError, match="--recorded"):
            call(capsys, folder, "--recorded", wrong)


FIGURES = {
    "likeness": {"quantities": [{"quantity": "yaw", "rare": 3.0, "found": {"dream": {"value": 0.2, "error": 0.01}}}]},
    "noise": 0.3, "first_seed": 20000, "driver": "f00",
    "probe": {"drives": 2, "known": [{"quantity": "speed", "found": {"zh_linear": {"value": 0.86, "error": 0.01}}}]},
    "losses": {
        "begun": [{"begun": "40 steps before", "figures": {"lost": {"dream": {"value": 0.6, "error": 0.07}}}}],
    },
}  # fmt: skip


def test_figures_that_were_measured_stay_with_the_bundle(trained, tmp_path, capsys):
    folder, figures = trained("plain"), tmp_path / "figures.json"
    bare = json.loads(call(capsys, folder, "--json"))["sha256"]
    figures.write_text(json.dumps({"bundle": bare, **FIGURES}))
    assert json.loads(call(capsys, folder, "--measured", str(figures), "--json"))["sha256"] != bare
    bundle = Bundle.open(folder / "b.zip")
    assert bundle.manifest.provenance["measured"] == [FIGURES]
    assert {"0.86 ± 0.01", "0.20 ± 0.01", "0.60 ± 0.07"} <= {value for _, value in manifest_facts(bundle)}
    for content in (
        json.dumps({"bundle": "0" * 64, **FIGURES}), json.dumps({"bundle": bare, **FIGURES, "noise": float("nan")}),
        json.dumps({"bundle": bare, "driver": "", "noise": 0, "first_seed": 0}), "{}", "[" * 100_000, "",
    ):  # fmt: skip
        figures.write_text(content)
        with pytest.raises(DatasetError, match=r"figures\.json"):
            call(capsys, folder, "--measured", str(figures))
        assert Bundle.open(folder / "b.zip").sha256 == bundle.sha256


@pytest.mark.parametrize("content", [7, [7], [{"probe": 7}], [{"probe": {"known": [{"quantity": 1}]}}]])
def test_malformed_figures_in_a_manifest_are_left_out(tmp_path, content):
    bundle = write_random_bundle(tmp_path / "b.zip")
    bundle.manifest.provenance["measured"] = content
    assert not [name for name, _ in manifest_facts(bundle) if "R²" in name]
