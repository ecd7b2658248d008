"""Tests bundle.py and bundle_store.py."""

import os
import re
import shutil
import zipfile

import numpy as np
import onnx
import pytest

from dreamfleet.common.artifacts import bundle_store
from dreamfleet.common.artifacts.bundle import (
    DECODER,
    DREAM_GRAPH,
    ENCODER,
    LINEAR_CONTROLLER,
    MANIFEST,
    POLICY,
    REQUIRED,
    Bundle,
    hash_file,
    write_bundle,
)
from dreamfleet.common.artifacts.bundle_store import BundleStore, describe_bundle, find_bundle, shipped_bundles
from dreamfleet.common.errors import BundleError
from dreamfleet.worker.worldmodel.inference import PolicyStep
from tests.support.bundles import states, write_random_bundle

LARGEST_SHIPPED = 16_000_000


def parts_of(bundle):
    return {name: bundle.read(name) for name in bundle.manifest.parts}


def test_equal_parts_give_equal_files(random_bundle, tmp_path):
    again = write_bundle(tmp_path / "again.zip", random_bundle.manifest, parts_of(random_bundle))
    assert again.sha256 == random_bundle.sha256 == hash_file(random_bundle.path)


def test_shipped_bundles_are_valid_and_small():
    parameters, errors = {"tiny": 867, "takecover": 963}, {"tiny": 25, "takecover": 40}
    assert shipped_bundles().keys() == parameters.keys()
    for name, path in shipped_bundles().items():
        bundle = find_bundle(name)
        assert path.stat().st_size <= LARGEST_SHIPPED
        assert bundle.controller_shape.size == parameters[name]
        assert bundle.manifest.provenance["quality"]["reconstruction_error"] < errors[name]


def truncate(path):
    os.truncate(path, path.stat().st_size // 2)


def empty(path):
    path.write_bytes(b"")


def text(path):
    path.write_text("this is no bundle")


def flip_a_byte(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def drop_a_part(path):
    rewrite(path, lambda name, data: None if name == ENCODER else data)


def swap_a_part(path):
    rewrite(path, lambda name, data: data[::-1] if name == ENCODER else data)


def break_the_manifest(path):
    rewrite(path, lambda name, data: b"{" if name == MANIFEST else data)


def drop_the_manifest(path):
    rewrite(path, lambda name, data: None if name == MANIFEST else data)


def of_tomorrow(path):
    rewrite(path, lambda name, data: data.replace(b'"format": 1', b'"format": 2') if name == MANIFEST else data)


def rewrite(path, change):
    with zipfile.ZipFile(path) as archive:
        entries = [(name, archive.read(name)) for name in archive.namelist()]
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in entries:
            if (changed := change(name, data)) is not None:
                archive.writestr(name, changed)


@pytest.mark.parametrize(
    "damage",
    [
        truncate, empty, text, flip_a_byte, drop_a_part, swap_a_part, break_the_manifest, drop_the_manifest,
        of_tomorrow,
    ],
)  # fmt: skip
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
@pytest.mark.parametrize(
    "change", [lambda part: b"", without_nodes, lambda part: onnx.ModelProto().SerializeToString()]
)
def test_an_empty_graph_is_refused_with_its_name(random_bundle, tmp_path, name, change):
    parts = parts_of(random_bundle)
    with pytest.raises(BundleError, match=rf"b\.zip.* {name}"):
        write_bundle(tmp_path / "b.zip", random_bundle.manifest, {**parts, name: change(parts[name])})


@pytest.mark.parametrize("name", REQUIRED)
def test_a_bundle_of_any_world_needs_its_dream_and_both_ends_of_its_vae(random_bundle, tmp_path, name):
    parts = parts_of(random_bundle)
    del parts[name]
    with pytest.raises(BundleError):
        write_bundle(tmp_path / "less.zip", random_bundle.manifest, parts)


def test_without_graphs_of_its_controllers_a_bundle_drives_by_its_dreams_graph(random_bundle, tmp_path):
    needed = {name: random_bundle.read(name) for name in REQUIRED}
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


def test_the_error_for_a_missing_bundle_lists_the_shipped_ones(tmp_path):
    with pytest.raises(BundleError, match=r"'huge'.*tiny"):
        find_bundle("huge")
    with pytest.raises(BundleError, match=r"absent\.zip"):
        Bundle.open(tmp_path / "absent.zip")


def test_the_store_finds_shipped_and_downloaded_bundles(random_bundle, tmp_path):
    store = BundleStore(tmp_path)
    shipped = find_bundle("tiny")
    assert store.find(shipped.sha256).path == shipped.path
    assert store.find(random_bundle.sha256) is None
    with store.lock_download(random_bundle.sha256) as partial:
        shutil.copyfile(random_bundle.path, partial)
        assert store.finish_download(random_bundle.sha256).sha256 == random_bundle.sha256
    assert store.find(random_bundle.sha256) is not None


def test_a_damaged_download_is_refused_and_removed(random_bundle, tmp_path):
    store = BundleStore(tmp_path)
    with store.lock_download(random_bundle.sha256) as partial:
        partial.write_bytes(b"something else")
        with pytest.raises(BundleError, match=random_bundle.sha256[:12]):
            store.finish_download(random_bundle.sha256)
        assert not partial.exists()


def test_a_damaged_cached_copy_is_fetched_again(random_bundle, tmp_path):
    store = BundleStore(tmp_path)
    with store.lock_download(random_bundle.sha256) as partial:
        shutil.copyfile(random_bundle.path, partial)
        flip_a_byte(store.finish_download(random_bundle.sha256).path)
    assert store.find(random_bundle.sha256) is None


def test_other_weights_give_another_hash(random_bundle, tmp_path):
    assert write_random_bundle(tmp_path / "other.zip", seed=1).sha256 != random_bundle.sha256


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
