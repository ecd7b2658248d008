"""Delta bundles: shipped without the parts of their base, and rebuilt. Tests bundle_store.py."""

import json
import re
from zipfile import ZipFile

import pytest

from dreamfleet.common.artifacts import bundle_store
from dreamfleet.common.artifacts.bundle import DREAM_GRAPH, MANIFEST, Bundle, write_bundle
from dreamfleet.common.artifacts.bundle_store import DELTA_MANIFEST, BundleStore, find_bundle
from dreamfleet.common.errors import BundleError
from dreamfleet.common.files.archives import write_archive
from tests.support.bundles import states, write_random_bundle


@pytest.fixture
def shelf(tmp_path, monkeypatch):
    """A folder of shipped bundles: `base` whole, and `able` as a delta to it."""
    folder = tmp_path / "ships"
    folder.mkdir()
    monkeypatch.setattr(bundle_store, "pretrained_folder", lambda: folder)
    monkeypatch.setenv("DREAMFLEET_CACHE", str(tmp_path / "cache"))
    base = write_random_bundle(folder / "base.zip")
    other = write_random_bundle(tmp_path / "other.zip", recorded=states(5))
    shared = {name: base.read(name) for name in base.manifest.parts}
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
    found = find_bundle("able")
    assert found.sha256 == whole.sha256
    assert found.path.read_bytes() == whole.path.read_bytes()
    assert found.read(DREAM_GRAPH) == whole.read(DREAM_GRAPH)
    assert find_bundle("able").path == found.path, "it was put together once"
    assert BundleStore(bundle_store.default_cache()).find(whole.sha256).path == found.path


def test_a_controller_finds_its_world_model_by_hash(shelf):
    _, whole = shelf
    assert BundleStore(bundle_store.default_cache()).find(whole.sha256).sha256 == whole.sha256


def test_a_damaged_cached_copy_is_rebuilt(shelf):
    _, whole = shelf
    path = find_bundle("able").path
    path.write_bytes(b"damaged")
    assert find_bundle("able").sha256 == whole.sha256


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


def test_shipped_names_include_deltas(shelf):
    with pytest.raises(BundleError, match="base, able"):
        find_bundle("nobody")


def test_an_unwritable_cache_is_an_error(shelf, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("DREAMFLEET_CACHE", str(tmp_path / "file"))
    with pytest.raises(BundleError, match=re.escape(str(tmp_path / "file"))):
        find_bundle("able")


def test_shipped_deltas_can_be_rebuilt():
    for name in bundle_store.shipped_names():
        assert isinstance(find_bundle(name), Bundle)
