"""Bundles, whole and as deltas without the parts of their base. Tests bundle.py and bundle_store.py."""

import json
import os
import re
import shutil
from dataclasses import replace
from zipfile import ZipFile

import numpy as np
import onnx
import pytest

from dreamfleet.common.artifacts import bundle as bundle_module
from dreamfleet.common.artifacts import bundle_store
from dreamfleet.common.artifacts.actions import Continuous, one_hot
from dreamfleet.common.artifacts.bundle import (
    DECODER,
    DREAM_GRAPH,
    ENCODER,
    INITIAL_LATENTS_PART,
    LINEAR_CONTROLLER,
    MANIFEST,
    MAX_BUNDLE,
    MAX_MANIFEST,
    POLICY,
    REQUIRED,
    Bundle,
    hash_file,
    write_bundle,
)
from dreamfleet.common.artifacts.bundle_store import (
    DELTA_MANIFEST,
    BundleStore,
    describe_bundle,
    find_bundle,
    shipped_bundles,
)
from dreamfleet.common.artifacts.car_racing_variants import FACTS, Variant
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.driving import WorldDriving
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts, WorldFacts
from dreamfleet.common.errors import BundleError, ControllerError, UsageError
from dreamfleet.common.files.archives import write_archive
from dreamfleet.worker.worldmodel.inference import PolicyStep
from dreamfleet.worker.worlds.car_racing.task import WORLD
from tests.support.bundles import parts_of, rewrite, states, write_random_bundle, write_world_bundle

LARGEST_SHIPPED = 16_000_000


def test_equal_parts_give_equal_files(random_bundle, tmp_path):
    again = write_bundle(tmp_path / "again.zip", random_bundle.manifest, parts_of(random_bundle))
    assert again.sha256 == random_bundle.sha256 == hash_file(random_bundle.path)
    assert write_random_bundle(tmp_path / "other.zip", seed=1).sha256 != random_bundle.sha256, "of other weights"


def test_shipped_bundles_are_valid_and_small():
    figures = {"tiny": (867, 25), "takecover": (963, 40)}
    assert shipped_bundles().keys() == figures.keys()
    for name, (parameters, error) in figures.items():
        bundle = find_bundle(name)
        assert bundle.path.stat().st_size <= LARGEST_SHIPPED
        assert bundle.controller_shape.size == parameters
        assert bundle.manifest.provenance["quality"]["reconstruction_error"] < error


def flip_a_byte(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def in_member(named, change):
    """Rewrite a bundle with one member changed, or left out for `None`."""
    return lambda path: rewrite(path, lambda name, data: change(data) if name == named else data)


DAMAGES = {
    "truncated": lambda path: os.truncate(path, path.stat().st_size // 2),
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("this is no bundle"),
    "a flipped byte": flip_a_byte,
    "a lost part": in_member(ENCODER, lambda data: None),
    "a swapped part": in_member(ENCODER, lambda data: data[::-1]),
    "a broken manifest": in_member(MANIFEST, lambda data: b"{"),
    "a lost manifest": in_member(MANIFEST, lambda data: None),
    "a later format": in_member(MANIFEST, lambda data: data.replace(b'"format": 1', b'"format": 2')),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_damage_is_a_one_line_error_that_names_the_file(random_bundle, tmp_path, damage):
    path = tmp_path / "copy.zip"
    shutil.copyfile(random_bundle.path, path)
    damage(path)
    with pytest.raises(BundleError, match=re.escape(str(path))) as error:
        Bundle.open(path)
    assert "\n" not in str(error.value)


def without_nodes(part):
    model = onnx.load_from_string(part)
    del model.graph.node[:]
    return model.SerializeToString()


@pytest.mark.parametrize("name", [ENCODER, DECODER, POLICY, DREAM_GRAPH, LINEAR_CONTROLLER])
@pytest.mark.parametrize("change", [lambda _: b"", without_nodes, lambda _: onnx.ModelProto().SerializeToString()])
def test_an_empty_graph_is_refused_with_its_name(random_bundle, tmp_path, name, change):
    parts = parts_of(random_bundle)
    with pytest.raises(BundleError, match=rf"b\.zip.* {name}"):
        write_bundle(tmp_path / "b.zip", random_bundle.manifest, {**parts, name: change(parts[name])})


@pytest.mark.parametrize(
    ("change", "lost", "largest"),
    [({}, INITIAL_LATENTS_PART, MAX_BUNDLE), ({"actions": 2}, None, MAX_BUNDLE), ({}, None, 1000),
     ({"provenance": {"x": "x" * MAX_MANIFEST}}, None, MAX_BUNDLE)],
)  # fmt: skip
def test_one_that_its_reader_would_refuse_replaces_nothing(change, lost, largest, random_bundle, tmp_path, monkeypatch):
    shutil.copy(random_bundle.path, path := tmp_path / "b.zip")
    parts, manifest = without(parts_of(random_bundle), lost), replace(random_bundle.manifest, **change)
    monkeypatch.setattr(bundle_module, "MAX_BUNDLE", largest)
    with pytest.raises(OSError if largest < MAX_BUNDLE else BundleError):
        write_bundle(path, manifest, parts)
    assert hash_file(path) == random_bundle.sha256
    assert list(tmp_path.iterdir()) == [path]


def without(parts, lost):
    return {name: data for name, data in parts.items() if name != lost}


def test_a_bundle_needs_its_dream_and_both_ends_of_its_vae_and_drives_by_the_dreams_graph(random_bundle, tmp_path):
    needed = {name: random_bundle.read(name) for name in REQUIRED}
    for lost in REQUIRED:
        with pytest.raises(BundleError):
            write_bundle(tmp_path / "less.zip", random_bundle.manifest, without(needed, lost))
    bare = write_bundle(tmp_path / "bare.zip", random_bundle.manifest, needed)
    random = np.random.default_rng(3)
    parameters = random.normal(0, 0.3, (2, bare.controller_shape.size)).astype(np.float32)
    pictures = random.integers(0, 256, (2, 64, 64, 3), dtype=np.uint8)
    whole, split = (
        step.step(pictures, parameters, step.zero_state(2)).action
        for step in (PolicyStep(random_bundle), PolicyStep(bare))
    )
    np.testing.assert_allclose(split, whole, atol=1e-5)
    assert bare.with_controllers(bare.shape_of("z", 4)).controller_shape.hidden == 4


def test_recorded_states_are_counted(random_bundle, tmp_path):
    assert random_bundle.recorded_count == 0
    with pytest.raises(BundleError, match="--recorded"):
        random_bundle.read_recorded()
    kept = states(7)
    some = write_random_bundle(tmp_path / "some.zip", recorded=kept)
    assert some.recorded_count == 7
    assert np.array_equal(some.read_recorded(), kept)


def test_the_store_finds_shipped_and_downloaded_bundles(random_bundle, tmp_path):
    store = BundleStore(tmp_path)
    shipped = find_bundle("tiny")
    assert store.find(shipped.sha256).path == shipped.path
    assert store.find(random_bundle.sha256) is None
    with store.lock_download(random_bundle.sha256) as partial:
        shutil.copyfile(random_bundle.path, partial)
        assert store.finish_download(random_bundle.sha256).sha256 == random_bundle.sha256
    assert store.find(random_bundle.sha256) is not None
    with store.lock_download(random_bundle.sha256) as partial:
        partial.write_bytes(b"something else")
        with pytest.raises(BundleError, match=random_bundle.sha256[:12]):
            store.finish_download(random_bundle.sha256)
        assert not partial.exists()


@pytest.mark.parametrize("name", ["", "abc", "../" * 20 + "etc0", "AB" * 32, "ab" * 31 + "/x"])
def test_an_invalid_hash_never_becomes_a_path(tmp_path, name):
    store = BundleStore(tmp_path)
    with pytest.raises(BundleError):
        store.find(name)
    with pytest.raises(BundleError), store.lock_download(name):
        pass
    assert not list(tmp_path.iterdir())


def test_an_error_text_names_what_ships_and_is_no_error_of_a_file_that_is_damaged(tmp_path, monkeypatch):
    for name in ("tiny", "able"):
        sha256 = find_bundle(name).sha256
        assert re.search(f" {name} .*{sha256[:12]}", describe_bundle(sha256))
    monkeypatch.setattr(bundle_store, "pretrained_folder", lambda: tmp_path)
    (tmp_path / "folder.zip").mkdir()
    assert describe_bundle("ab" * 32).endswith(" abababababab")
    (tmp_path / "folder.zip").rmdir()
    (tmp_path / "damaged.lean").write_bytes(b"x")
    assert describe_bundle("ab" * 32).endswith(" abababababab")


@pytest.fixture
def shelf(tmp_path, monkeypatch):
    """A folder of shipped bundles: `base` whole, and `able` as a delta to it."""
    folder = tmp_path / "ships"
    folder.mkdir()
    monkeypatch.setattr(bundle_store, "pretrained_folder", lambda: folder)
    monkeypatch.setenv("DREAMFLEET_CACHE", str(tmp_path / "cache"))
    base = write_random_bundle(folder / "base.zip")
    other = write_random_bundle(tmp_path / "other.zip", recorded=states(5))
    shared = parts_of(base)
    own = {name: other.read(name) for name in other.manifest.parts.keys() - shared.keys()}
    whole = write_bundle(tmp_path / "whole.zip", other.manifest, {**shared, **own})
    about = {"sha256": whole.sha256, "base": "base", "parts": [MANIFEST, *sorted(whole.manifest.parts)]}
    with (folder / "able.lean").open("wb") as file, ZipFile(whole.path) as members:
        own_parts = [(name, members.read(name)) for name in (MANIFEST, *sorted(own))]
        write_archive(file, [(DELTA_MANIFEST, json.dumps(about).encode()), *own_parts])
    return folder, whole


def test_rebuilding_gives_the_original_bundle_to_the_byte(shelf):
    folder, whole = shelf
    assert (folder / "able.lean").stat().st_size < whole.path.stat().st_size / 3
    found = BundleStore(bundle_store.default_cache()).find(whole.sha256)  # as a controller finds its world model
    assert found.path.read_bytes() == whole.path.read_bytes()
    assert find_bundle("able").path == found.path, "it was put together once"
    found.path.write_bytes(b"damaged")
    assert find_bundle("able").sha256 == whole.sha256, "and is again where that copy is damaged"
    with pytest.raises(BundleError, match="base, able"):
        find_bundle("nobody")


@pytest.mark.parametrize(
    "harm",
    [
        lambda folder: (folder / "able.lean").write_bytes(b""),
        lambda folder: (folder / "able.lean").write_bytes((folder / "able.lean").read_bytes()[:-100]),
        lambda folder: (folder / "base.zip").unlink(),
        lambda folder: (folder / "base.zip").write_bytes(b"no zip"),
        lambda folder: write_random_bundle(folder / "base.zip", seed=9),
    ],
)
def test_a_damaged_delta_or_missing_base_is_an_error(shelf, harm):
    folder, _ = shelf
    harm(folder)
    with pytest.raises(BundleError) as raised:
        find_bundle("able")
    assert "\n" not in str(raised.value)


ABOUT = {
    "packages": ("numpy", "onnxruntime", "gymnasium"), "horizon": 200, "frames_per_second": 10, "score_word": "game",
    "reward": RewardFacts("survival"), "end": EndRule("drawn"), "marks": (100.0,),
}  # fmt: skip
KINDS = {"one-hot": one_hot(3), "thirds": Continuous.between([-1], [1])}
SIZES = {"one-hot": 3 * 289, "thirds": 289}


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def bundle(kind, tmp_path_factory):
    facts = WorldFacts.of(KINDS[kind], **ABOUT)
    return write_world_bundle(tmp_path_factory.mktemp("world") / "world.zip", facts)


def test_a_bundle_describes_its_world_and_its_controllers(bundle, kind):
    opened = Bundle.open(bundle.path, bundle.sha256)
    assert opened.manifest.world == WorldFacts.of(KINDS[kind], **ABOUT)
    assert not {POLICY, LINEAR_CONTROLLER} & opened.manifest.parts.keys()
    assert bundle.controller_shape.size == SIZES[kind]
    assert bundle.shape_of("z", hidden=5).size == 5 * 33 + KINDS[kind].outputs * 6
    seen = bundle.with_options(None, '{"feedback": "last"}')
    assert seen.controller_shape.features == 288 + 2 * KINDS[kind].outputs
    assert seen.driving == WorldDriving(bundle.manifest.world, feedback="last")


def test_a_controller_belongs_to_its_bundle_and_no_other(bundle, random_bundle):
    def controller(options):
        shape = bundle.with_options(None, options).controller_shape
        return Controller(shape, np.zeros(shape.size, np.float32), "dream", bundle.sha256, options=options)

    for options in ("", '{"decide_every": 3}'):
        assert bundle.for_controller(controller(options)).driving.options == options
    with pytest.raises(UsageError, match="pedals"):
        bundle.for_controller(replace(controller(""), options='{"pedals": "one"}'))
    with pytest.raises(ControllerError, match=r"world\.zip"):
        bundle.with_controllers(replace(bundle.controller_shape, features=7))
    with pytest.raises(BundleError, match=r"world\.zip .*DodgeTask .*pedals"):
        bundle.with_controllers(None, Variant(pedals="one"))
    with pytest.raises(UsageError, match=r"world\.zip"):
        bundle.variant  # noqa: B018 - reading it fails


def test_what_cannot_be_is_refused(bundle, tmp_path):
    parts = parts_of(bundle)
    with pytest.raises(BundleError, match=r"a\.zip"):
        write_bundle(tmp_path / "a.zip", replace(bundle.manifest, actions=2), parts)
    for wrong in (None, "x", float("nan"), True):
        manifest = replace(bundle.manifest, models={"mdnrnn": {"reward_scale": wrong}})
        with pytest.raises(BundleError, match="reward_scale"):
            write_bundle(tmp_path / "a.zip", manifest, parts)
    rewritten = shutil.copy(bundle.path, tmp_path / "c.zip")
    rewrite(rewritten, lambda name, data: data.replace(b'"low": [', b'"low": [9.5, ') if name == MANIFEST else data)
    with pytest.raises(BundleError, match=r"c\.zip"):
        Bundle.open(rewritten)


def test_a_bundle_says_its_world_and_car_racings_has_variants(random_bundle, tmp_path):
    assert random_bundle.manifest.world == find_bundle("tiny").manifest.world == FACTS
    assert WORLD.facts(FACTS.reward, EndRule()) == FACTS
    assert FACTS.actions == Variant().controls
    moon = write_bundle(tmp_path / "m.zip", replace(random_bundle.manifest, task="moon"), parts_of(random_bundle))
    assert moon.driving == WorldDriving(FACTS)
    rewrite(moon.path, lambda name, data: data.replace(b'"world"', b'"earth"') if name == MANIFEST else data)
    with pytest.raises(BundleError, match=r"m\.zip.*world"):
        Bundle.open(moon.path)
