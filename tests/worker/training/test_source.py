"""A whole source by one verb: a share of each preset, from drives to a bundle, and on from where it stopped."""

import argparse
import json
from pathlib import Path

import pytest

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.errors import StoppedError, UsageError
from dreamfleet.worker.training.presets import PRESETS
from dreamfleet.worker.training.source import STAGES, Source
from dreamfleet.worker.verbs import encode as encode_verb
from dreamfleet.worker.verbs import pipeline
from dreamfleet.worker.worldmodel.inference import PolicyStep

# SWIG warns as Box2D is imported, and an error there kills the process.
pytestmark = pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")
SHARES = {"tiny": 0.004, "notebook": 0.0005, "article": 0.0002, "attentive": 0.001, "paper": 0.00002}
FEW = ("--jobs", "1", "--collect-flags", "--steps 24", "--vae-flags", "--batch 4")


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def call(*arguments):
    parser = argparse.ArgumentParser()
    pipeline.configure(parser)
    return pipeline.run(parser.parse_args([str(each) for each in arguments]))


def made(folder, preset):
    return Bundle.open(folder / f"{preset}.zip")


@pytest.mark.parametrize("name", PRESETS)
def test_a_share_of_a_preset_becomes_a_bundle_of_its_own_layers(name, tmp_path, capsys):
    assert call("--data", tmp_path, "--preset", name, "--scale", SHARES[name], *FEW, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert tuple(told["stages"]) == STAGES
    bundle, preset = made(tmp_path, name), PRESETS[name]
    assert told["stages"]["bundle"]["sha256"] == bundle.sha256
    assert bundle.manifest.picture[0] == preset.collect.picture
    assert bundle.manifest.hidden == preset.mdnrnn_layers.hidden
    assert bundle.manifest.provenance["episodes"] >= 2
    assert PolicyStep(bundle).zero_state(1).shape == (1, preset.mdnrnn_layers.state)


def test_it_goes_on_where_it_stopped_to_the_same_bundle(tmp_path, monkeypatch, capsys):
    flags = ("--preset", "article", "--scale", "0.0001", *FEW)
    assert call("--data", tmp_path / "whole", *flags) == 0
    assert "controllers of 867 parameters" in capsys.readouterr().out

    def stop(_args):
        raise StoppedError("stopped")

    with monkeypatch.context() as patched:
        patched.setattr(encode_verb, "run", stop)
        with pytest.raises(StoppedError):
            call("--data", tmp_path / "stopped", *flags)
    assert not (tmp_path / "stopped" / "encoded").exists()
    for _ in range(2):  # and once more, when all is finished
        assert call("--data", tmp_path / "stopped", *flags) == 0
        assert made(tmp_path / "stopped", "article").sha256 == made(tmp_path / "whole", "article").sha256


def test_a_share_of_every_amount_is_rounded_up():
    stages = Source(PRESETS["notebook"], Path("data"), scale=0.02).stages(2, "cpu")
    assert "--episodes 20" in " ".join(stages["collect"])
    assert "--updates 600 --validate-every 4" in " ".join(stages["train.vae"])
    assert "--updates 200 --validate-every 4" in " ".join(stages["train.mdnrnn"])
    least = Source(PRESETS["tiny"], Path("data"), scale=1e-6).stages(2, "cpu")
    assert "--episodes 2" in " ".join(least["collect"])
    assert "--updates 1" in " ".join(least["train.vae"])


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--scale", "0"), "--scale must be above 0, to 1, not 0"),
        (("--scale", "2"), "--scale must be above 0, to 1, not 2"),
        (("--vae-flags", "--dat other"), "--vae-flags: --data of a stage"),
        (("--collect-flags", "'"), "--collect-flags"),
        (("--preset", "dream"), "'dream' is a preset of run"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_driven(tmp_path, flags, said):
    with pytest.raises(UsageError, match=said):
        call("--data", tmp_path / "data", *flags)
    assert not (tmp_path / "data").exists()


def test_an_unknown_flag_of_a_stage_is_refused_before_anything_is_driven(tmp_path):
    with pytest.raises(SystemExit):
        call("--data", tmp_path / "data", "--mdnrnn-flags", "--ghost 1")
    assert not (tmp_path / "data").exists()


def test_another_preset_than_the_data_sets_is_refused(tmp_path):
    (tmp_path / "preset.json").write_text('{"preset": "paper"}')
    with pytest.raises(UsageError, match="give --preset paper"):
        call("--data", tmp_path)
