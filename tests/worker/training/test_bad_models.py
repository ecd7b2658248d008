"""Malformed bundles and data sets are refused in one line before anything runs; what a bundle says of dreams.
Tests dream_facts.py and common/artifacts/onnx_checks.py."""

import re
import shutil
from dataclasses import replace

import numpy as np
import onnx
import pytest

from dreamfleet.common.artifacts.bundle import DREAM_GRAPH, INITIAL_LATENTS_PART, POLICY, RECORDED_STATES, write_bundle
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.car_racing_variants import FACTS
from dreamfleet.common.artifacts.onnx_checks import has_finite_weights
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import BundleError, DatasetError, UsageError
from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD, DataWorld
from dreamfleet.worker.tasks.api import DreamReward
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.assemble import export_graphs, make_manifest
from dreamfleet.worker.training.data.dataset import load_arrays
from dreamfleet.worker.training.dream_facts import NO_DRIVES, RecordedRewards, describe_world, warn_of_unsure_ends
from dreamfleet.worker.training.encode import encode
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel.inference import DreamStep, Encoder, PolicyStep
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import npy, parts_of
from tests.support.drives import ignore, train_models, write_drive, write_drives
from tests.support.models import random_models, weights
from tests.support.pixel_world import DodgeTask

LAYERS, RNN = VAEConfig(latent=4, channels=(4, 4, 8, 8)), MDNRNNConfig(latent=4, hidden=8, mixtures=2)
SHORT = TrainConfig(updates=2, batch=8, rate=1e-3)
WHOLE = {INITIAL_LATENTS_PART: np.zeros((4, 2, 32), np.float32), RECORDED_STATES: np.zeros((4, 576), np.float16)}


def damaged(whole):
    """An array's content spoilt."""
    return [whole + np.nan, whole + np.inf, whole.astype(np.int64), np.array([object()]), npy(whole)[:-1], b""]


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["encoder.0.weight", "lstm.weight_ih_l0", "heads.weight"])
def test_weights_that_are_no_numbers_are_refused(tmp_path, name, value):
    models = [weights(each) for each in random_models(0, LAYERS, RNN)]
    model = next(each for each in models if name in each)
    model[name] = model[name].copy()
    model[name].flat[3] = value
    parts = export_graphs(*models, np.zeros((1, 2, 4), np.float32), LAYERS, RNN)
    with pytest.raises(BundleError):
        write_bundle(tmp_path / "b.zip", make_manifest("b", {}, FACTS, LAYERS, RNN), parts)


def test_what_ships_and_what_is_no_model_have_no_wrong_weights():
    assert has_finite_weights(find_bundle("tiny").read(POLICY))
    assert has_finite_weights(b"x")
    data = find_bundle("tiny").read(POLICY)[:2000]
    for cut in range(0, 2000, 7):
        assert has_finite_weights(data[:cut])


@pytest.mark.parametrize(
    ("part", "content"),
    [
        *((INITIAL_LATENTS_PART, np.zeros(shape, np.float32)) for shape in ((0, 2, 32), (4, 2, 16))),
        *((RECORDED_STATES, np.zeros(shape, np.float16)) for shape in ((0, 576), (16_385, 576), (4, 575), (4, 2, 576))),
        *((part, content) for part, whole in WHOLE.items() for content in damaged(whole)),
    ],
)
def test_damaged_latents_or_states_that_dreams_begin_at_are_one_clear_line(random_bundle, tmp_path, part, content):
    data = content if isinstance(content, bytes) else npy(content)
    with pytest.raises(BundleError, match=rf"b\.zip.*{re.escape(part)}") as caught:
        write_bundle(tmp_path / "b.zip", random_bundle.manifest, {**parts_of(random_bundle), part: data})
    assert "\n" not in str(caught.value)


def test_graphs_of_other_sizes_than_the_manifest_says_are_refused(random_bundle, tmp_path):
    parts = {**parts_of(random_bundle), INITIAL_LATENTS_PART: npy(np.zeros((1, 2, 16), np.float32))}
    other = write_bundle(tmp_path / "b.zip", replace(random_bundle.manifest, latent=16), parts)
    for part in (PolicyStep, DreamStep, Encoder):
        with pytest.raises(BundleError):
            part(other)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    write_drives(folder, episodes=4, steps=6)
    return train_models(folder, SHORT, LAYERS, RNN)


@pytest.fixture
def folder(trained, tmp_path):
    return shutil.copytree(trained, tmp_path / "data")


def test_a_half_written_episode_stops_training_before_its_first_update(folder):
    path = sorted((folder / "episodes").glob("*.npz"))[-1]
    path.write_bytes(path.read_bytes()[:-50])
    (folder / train_vae.CHECKPOINT).unlink()
    seen = []
    with pytest.raises(DatasetError):
        train_vae.train_vae(folder, SHORT, lambda done, _: seen.append(done), LAYERS)
    with pytest.raises(DatasetError):
        train_mdnrnn.train_mdnrnn(folder, SHORT, lambda done, _: seen.append(done), RNN)
    assert not seen


def test_an_episode_without_its_actions_is_refused(folder):
    path = sorted((folder / "episodes").glob("*.npz"))[1]
    np.savez(path, **load_arrays(path, "picture", "reward", "preprocessing", "world", "ended"))
    with pytest.raises(DatasetError, match=r"action\.npy"):
        list(encode(folder))


def test_a_half_written_encoded_episode_is_encoded_again(folder):
    path = sorted((folder / "encoded").glob("*.npz"))[1]
    whole = load_arrays(path, "mu")["mu"]
    path.write_bytes(path.read_bytes()[:100])
    assert len(list(encode(folder))) == 1
    assert np.array_equal(load_arrays(path, "mu")["mu"], whole)


def test_an_mdnrnn_of_other_latents_is_refused(folder):
    (folder / train_mdnrnn.CHECKPOINT).unlink()
    with pytest.raises(DatasetError):
        train_mdnrnn.train_mdnrnn(folder, SHORT, ignore, replace(RNN, latent=5))


def test_a_vae_of_another_size_than_the_data_is_refused_before_anything_runs(folder):
    shutil.rmtree(folder / "encoded")
    checkpoint = (folder / train_vae.CHECKPOINT).read_bytes()
    with pytest.raises(DatasetError, match=r"'box-64'.*'raw-96'.*--picture"):
        train_vae.train_vae(folder, SHORT, ignore, replace(LAYERS, picture=96), new=True)
    assert (folder / train_vae.CHECKPOINT).read_bytes() == checkpoint
    write_drive(folder, 4, picture=96)
    with pytest.raises(DatasetError, match=r"000004.npz.*'raw-96'"):
        list(encode(folder))
    assert not (folder / "encoded").exists()


def test_data_that_are_no_numbers_stop_training_and_keep_the_checkpoint(folder):
    before = (folder / train_mdnrnn.CHECKPOINT).read_bytes()
    for path in (folder / "encoded").glob("*.npz"):
        arrays = dict(np.load(path))
        np.savez(path, **{**arrays, "mu": arrays["mu"] * np.nan, "mirrored_mu": arrays["mu"] * np.nan})
    with pytest.raises(DatasetError):
        train_mdnrnn.train_mdnrnn(folder, replace(SHORT, updates=4), ignore, RNN)
    assert (folder / train_mdnrnn.CHECKPOINT).read_bytes() == before


def elsewhere(tensor):
    """The tensor, stored in another file."""
    tensor.ClearField("raw_data")
    tensor.ClearField("float_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="secret.bin")
    return tensor


def numbers():
    return elsewhere(onnx.numpy_helper.from_array(np.zeros(2, np.float32), "c"))


def constant():
    return onnx.helper.make_node("Constant", [], ["c"], value=numbers())


def branch():
    inner = onnx.helper.make_graph([], "inner", [], [], [numbers()])
    return onnx.helper.make_node("If", ["x"], ["y"], then_branch=inner, else_branch=inner)


@pytest.mark.parametrize(
    "change",
    [
        lambda model: elsewhere(model.graph.initializer[0]),
        lambda model: model.graph.node.append(constant()),
        lambda model: model.graph.node.append(branch()),
        lambda model: model.functions.append(onnx.helper.make_function("own", "f", [], ["c"], [constant()], [])),
    ],
    ids=["weights", "constant", "branch", "function"],
)
def test_a_graph_reads_no_other_file(random_bundle, tmp_path, monkeypatch, change):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secret.bin").write_bytes(bytes(10**7))
    model = onnx.load_from_string(random_bundle.read(POLICY))
    change(model)
    parts = {**parts_of(random_bundle), POLICY: model.SerializeToString()}
    with pytest.raises(BundleError, match=r"policy\.onnx"):
        write_bundle(tmp_path / "b.zip", random_bundle.manifest, parts)


@pytest.mark.parametrize(
    "change",
    [
        lambda whole: whole[:5000],
        lambda _whole: b"\x08\x08\x00\x00ORTM" + bytes(100),  # the runtime's own format
        lambda _whole: b"\xba\x80\x80\x80\x10\x00",  # field 7, if 32 bits of its number are looked at
        lambda _whole: b"\x3b\x3c",  # a group
    ],
)
def test_a_graph_that_is_cut_or_that_the_runtime_might_read_otherwise_is_not_run(random_bundle, tmp_path, change):
    parts = parts_of(random_bundle)
    parts[DREAM_GRAPH] = change(parts[DREAM_GRAPH])
    bundle = write_bundle(tmp_path / "b.zip", random_bundle.manifest, parts)
    with pytest.raises(BundleError, match=r"dream\.onnx"):
        DreamStep(bundle)


def test_a_graph_of_endless_fields_is_not_looked_through(random_bundle, tmp_path):
    parts = {**parts_of(random_bundle), DREAM_GRAPH: b"\x40\x00" * 10**6}
    with pytest.raises(BundleError, match="500000"):
        write_bundle(tmp_path / "b.zip", random_bundle.manifest, parts)


@pytest.mark.add_on
@pytest.mark.parametrize("place", ["", "episodes"])
@pytest.mark.parametrize("content", ["arrays", "half"])
def test_files_of_another_program_are_named_and_never_advised_to_be_deleted(tmp_path, place, content, capsys):
    (tmp_path / "episodes").mkdir()
    path = tmp_path / place / "000001.npz"
    np.savez(path, x=np.zeros(3), y=np.zeros(3))
    if content == "half":
        path.write_bytes(path.read_bytes()[:100])
    before = path.read_bytes()
    assert main(["pipeline", "--data", str(tmp_path), "--scale", "0.01"]) == 1
    said = capsys.readouterr().err
    assert "000001.npz" in said
    assert "--data" in said
    assert "delete" not in said
    assert not (tmp_path / "preset.json").exists()
    with pytest.raises(DatasetError, match="--data") as said:
        load_arrays(path, "action")
    assert "delete" not in str(said.value)
    assert path.read_bytes() == before
    assert [each.name for each in tmp_path.rglob("*.npz")] == ["000001.npz"]


ENDS = MDNRNNConfig(reward="none", done=True, done_weight=3.0)
VALUE = MDNRNNConfig(reward="value", done=True, done_weight=3.0)
LABEL = MDNRNNConfig(reward="positive")


def drive(*rewards):
    return np.array(rewards, np.float32)


LIVED = RecordedRewards.of([drive(4, 4, 4, 2), drive(4, 4)], deaths=1)
EARNED = RecordedRewards.of([drive(-0.1, 3.4, -0.1), drive(-0.1, 3.6)])
NOTHING = RecordedRewards.of([drive(0, 0, 0), drive(0, -1)])


class Silent(DodgeTask):
    """A world that says nothing of its reward."""

    world = replace(DodgeTask.world, dream_reward=None)


class Rich(DodgeTask):
    """A world that says what a reward is worth."""

    world = replace(DodgeTask.world, dream_reward=DreamReward(gain=9.0, cost=1.0))


def facts(recorded, layers, task=Silent, **more):
    return describe_world(DataWorld(f"{__name__}:{task.__name__}"), recorded, layers, **more)


def test_what_each_step_gave_is_survival_and_the_last_step_of_a_drive_may_give_less():
    assert RecordedRewards(3.66667, None, 4.0, 1) == LIVED
    assert RecordedRewards.of([drive(0.1, 0.1)]).each_step == 0.1
    assert RecordedRewards.of([drive(-1, -1, 0)]).each_step == -1.0
    for others in ([drive(4, 4, 5)], [drive(4, 4, -1)], [drive(4, 3, 4)], [drive(4, 4), drive(3, 3)], [drive(0, 0, 1)]):
        assert RecordedRewards.of(others).each_step is None
    assert (EARNED.positive, EARNED.other, EARNED.each_step) == (3.5, -0.1, None)
    assert RecordedRewards(None, -0.2, None) == NOTHING


def test_by_default_it_is_survival_where_the_data_are_or_else_what_the_model_predicts():
    assert facts(LIVED, VALUE).reward == RewardFacts("survival", gain=4.0)
    assert facts(LIVED, ENDS).end == EndRule("drawn", odds_weight=3.0)
    assert facts(LIVED, replace(VALUE, done=False, done_weight=1)).reward.source == "value", "no dream would end"
    assert facts(EARNED, VALUE).reward == RewardFacts("value")
    assert facts(EARNED, VALUE).end == EndRule(at=0.5, odds_weight=3.0)
    assert facts(EARNED, ENDS).reward.source == "survival", "nothing else is predicted"
    assert facts(EARNED, LABEL).reward == RewardFacts("label", gain=3.6, cost=0.1)
    assert facts(EARNED, LABEL).end == EndRule()


def test_a_model_without_drives_pays_as_its_world_says(caplog):
    for layers, reward in ((MDNRNNConfig(reward="none"), FACTS.reward), (LABEL, FACTS.reward), (VALUE, RewardFacts())):
        assert describe_world(OF_FIRST_WORLD, NO_DRIVES, layers).reward == reward
    assert not caplog.records


def test_what_is_chosen_is_taken_and_what_the_world_says_is_no_figure_of_the_data():
    both = replace(LABEL, done=True)
    assert facts(EARNED, both, reward="survival", end="0.25").end == EndRule(at=0.25)
    assert facts(LIVED, both, reward="label").reward.source == "label"
    assert facts(LIVED, both, end="drawn", reward="label").end.kind == "drawn"
    assert facts(EARNED, LABEL, Rich).reward == RewardFacts("label", 9.0, 1.0)
    assert facts(LIVED, ENDS, Rich).reward == RewardFacts("survival", 4.0)


@pytest.mark.parametrize(
    ("layers", "chosen"),
    [
        (LABEL, {"reward": "survival"}),
        (LABEL, {"reward": "value"}),
        (VALUE, {"reward": "label"}),
        (ENDS, {"reward": "value"}),
        (MDNRNNConfig(reward="none"), {}),
        (LABEL, {"end": "drawn"}),
        (VALUE, {"end": "1.5"}),
        (VALUE, {"end": "often"}),
    ],
)
def test_what_is_not_predicted_is_refused(layers, chosen):
    with pytest.raises(UsageError):
        facts(EARNED, layers, **chosen)


def test_what_the_data_lack_is_warned_of(caplog):
    facts(EARNED, VALUE)
    facts(RecordedRewards.of([drive(-1, -1, -1)], deaths=1), VALUE)
    assert not caplog.records, "to end sooner is a goal"
    facts(replace(LIVED, deaths=0), VALUE)
    assert facts(NOTHING, LABEL).reward == RewardFacts("label"), "no figure of what it never saw"
    assert len(caplog.records) == 2


def test_a_bar_that_uncertain_ends_may_never_reach_is_warned_of(caplog):
    for rule, quality in ((EndRule(), {"done_auc": 0.99}), (EndRule("drawn"), {"done_auc": 0.7}), (EndRule(), {})):
        warn_of_unsure_ends(rule, quality)
    assert not caplog.records
    warn_of_unsure_ends(EndRule(), {"done_auc": 0.708})
    assert "0.71" in caplog.text
