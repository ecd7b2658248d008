"""Tests recorded_states.py, worker/training/stages/bundle.py and worker/addons/bundles/verb.py."""

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
from dreamfleet.worker.training.data.dataset import load_arrays
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel.inference import DreamStep, RewardLabel
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.drives import ignore, train_models, write_drive
from tests.support.verbs import run_verb

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
