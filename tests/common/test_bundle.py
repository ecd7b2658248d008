import hashlib
import json
import zipfile

import pytest

from common.bundle import (
    ENCODER,
    INITIAL,
    MANIFEST,
    REQUIRED,
    WEIGHTS,
    Bundle,
    BundleStore,
    Manifest,
    default_cache,
    find_bundle,
    hash_file,
    write_bundle,
)
from common.errors import BundleError
from tests.support.bundles import write_random_bundle

PARTS = {name: name.encode() * 50 for name in REQUIRED}


def make_manifest(**provenance):
    return Manifest("b", "car-racing", "box-64", (64, 64, 3), 32, 256, 3, provenance=provenance)


@pytest.fixture
def bundle(tmp_path):
    return write_bundle(tmp_path / "b.zip", make_manifest(), PARTS)


def rewrite(path, changes):
    """Write the archive again with some entries changed, or left out where the change is `None`."""
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    entries |= changes
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in entries.items():
            if data is not None:
                archive.writestr(name, data)


def change_manifest(path, **changes):
    with zipfile.ZipFile(path) as archive:
        manifest = json.loads(archive.read(MANIFEST))
    rewrite(path, {MANIFEST: json.dumps({**manifest, **changes})})


def assert_refused(path, *words):
    """Refused with one line that holds the file's name and these words."""
    with pytest.raises(BundleError) as caught:
        Bundle.open(path)
    text = str(caught.value)
    assert "\n" not in text
    for word in (str(path), *words):
        assert word in text


def test_a_bundle_gives_back_what_was_written(bundle):
    assert {name: bundle.read(name) for name in PARTS} == PARTS
    assert bundle.sha256 == hash_file(bundle.path)
    assert bundle.controller_shape.features == bundle.manifest.latent + bundle.manifest.hidden
    assert bundle.manifest.picture == (64, 64, 3)


def test_equal_parts_make_equal_files_whatever_their_order(tmp_path, bundle):
    other = write_bundle(tmp_path / "other.zip", make_manifest(), dict(reversed(PARTS.items())))
    assert other.path.read_bytes() == bundle.path.read_bytes()


def test_equal_weights_make_equal_files(tmp_path):
    first, second = (write_random_bundle(tmp_path / f"{index}.zip") for index in range(2))
    assert first.sha256 == second.sha256
    assert write_random_bundle(tmp_path / "3.zip", seed=1).sha256 != first.sha256


def test_training_weights_are_optional(tmp_path):
    with_weights = write_bundle(tmp_path / "w.zip", make_manifest(), {**PARTS, WEIGHTS: b"weights"})
    assert Bundle.open(with_weights.path).read(WEIGHTS) == b"weights"


def test_a_part_that_is_not_there_is_named(bundle):
    with pytest.raises(BundleError, match=WEIGHTS):
        bundle.read(WEIGHTS)


def test_a_missing_file_is_refused(tmp_path):
    assert_refused(tmp_path / "absent.zip", "no bundle at")


@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04" + bytes(100)])
def test_a_file_of_another_kind_is_refused(tmp_path, content):
    path = tmp_path / "b.zip"
    path.write_bytes(content)
    assert_refused(path, "not a whole bundle")


def test_a_folder_is_refused(tmp_path):
    assert_refused(tmp_path, "not a whole bundle")


@pytest.mark.parametrize("share", [0.01, 0.5, 0.99])
def test_a_truncated_file_is_refused(bundle, share):
    data = bundle.path.read_bytes()
    bundle.path.write_bytes(data[: int(len(data) * share)])
    assert_refused(bundle.path, "not a whole bundle")


def test_another_programs_archive_is_refused(tmp_path):
    path = tmp_path / "b.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("holiday.jpg", b"sun")
    assert_refused(path, MANIFEST)


@pytest.mark.parametrize("part", REQUIRED)
def test_a_missing_part_is_refused(bundle, part):
    rewrite(bundle.path, {part: None})
    assert_refused(bundle.path, part)


def test_a_part_that_the_manifest_does_not_know_about_is_not_readable(bundle):
    rewrite(bundle.path, {"extra": b"x"})
    with pytest.raises(BundleError):
        Bundle.open(bundle.path).read("extra")


def test_a_part_of_another_hash_is_refused(bundle):
    rewrite(bundle.path, {ENCODER: b"another encoder"})
    assert_refused(bundle.path, ENCODER, "damaged")


def test_another_format_version_is_refused_before_its_fields_are_read(bundle):
    change_manifest(bundle.path, format=99, invented="later")
    assert_refused(bundle.path, "99")


@pytest.mark.parametrize(
    "changes", [{"latent": 0}, {"latent": "32"}, {"name": ""}, {"unknown": 1}, {"picture": "64"}, {"parts": []}]
)
def test_a_manifest_that_does_not_fit_is_refused(bundle, changes):
    change_manifest(bundle.path, **changes)
    assert_refused(bundle.path, "manifest")


@pytest.mark.parametrize("text", [b"", b"[]", b"null", b"{}", b"\xff\xfe", b'{"format": 1', b"[" * 100_000])
def test_a_manifest_that_is_no_document_is_refused(bundle, text):
    rewrite(bundle.path, {MANIFEST: text})
    assert_refused(bundle.path)


def test_every_flipped_bit_of_a_part_is_found(bundle):
    data = bytearray(bundle.path.read_bytes())
    data[data.index(PARTS[INITIAL])] ^= 1
    bundle.path.write_bytes(data)
    assert_refused(bundle.path)


def test_no_damage_to_any_byte_raises_another_kind_of_error(bundle):
    data = bundle.path.read_bytes()
    for position in range(0, len(data), 7):
        damaged = bytearray(data)
        damaged[position] ^= 0xFF
        bundle.path.write_bytes(damaged)
        try:
            opened = Bundle.open(bundle.path)
        except BundleError:
            continue
        assert {name: opened.read(name) for name in PARTS} == PARTS, position  # a byte that nothing depends on
        assert opened.sha256 != hashlib.sha256(data).hexdigest()


def test_an_interrupted_write_leaves_the_old_bundle(bundle):
    before = bundle.path.read_bytes()
    with pytest.raises(TypeError):
        write_bundle(bundle.path, make_manifest(bad=object()), PARTS)
    assert bundle.path.read_bytes() == before
    assert list(bundle.path.parent.iterdir()) == [bundle.path]


def test_the_store_finds_what_it_completed(tmp_path, bundle):
    store = BundleStore(tmp_path / "cache")
    assert store.find(bundle.sha256) is None
    store.partial(bundle.sha256).write_bytes(bundle.path.read_bytes())
    completed = store.complete(bundle.sha256)
    assert completed.sha256 == bundle.sha256
    assert BundleStore(tmp_path / "cache").find(bundle.sha256).manifest == bundle.manifest
    assert not store.partial(bundle.sha256).exists()


def test_the_store_keeps_the_beginning_of_a_download(tmp_path, bundle):
    BundleStore(tmp_path / "cache").partial(bundle.sha256).write_bytes(b"beginning")
    assert BundleStore(tmp_path / "cache").partial(bundle.sha256).read_bytes() == b"beginning"


def test_the_store_removes_a_damaged_download(tmp_path, bundle):
    store = BundleStore(tmp_path / "cache")
    store.partial(bundle.sha256).write_bytes(bundle.path.read_bytes()[:-1])
    with pytest.raises(BundleError, match="arrived damaged"):
        store.complete(bundle.sha256)
    assert not store.partial(bundle.sha256).exists()


def test_the_store_forgets_a_copy_that_was_damaged_later(tmp_path, bundle):
    store = BundleStore(tmp_path / "cache")
    store.partial(bundle.sha256).write_bytes(bundle.path.read_bytes())
    path = store.complete(bundle.sha256).path
    path.write_bytes(b"rot")
    assert store.find(bundle.sha256) is None
    assert not path.exists()


def test_the_store_finds_what_ships(tmp_path, bundle, monkeypatch):
    monkeypatch.setattr("common.bundle.pretrained", lambda: bundle.path.parent)
    assert BundleStore(tmp_path / "cache").find(bundle.sha256).path == bundle.path


def test_a_bundle_is_found_by_the_name_that_it_ships_under_or_by_path(bundle, monkeypatch):
    monkeypatch.setattr("common.bundle.pretrained", lambda: bundle.path.parent)
    assert find_bundle("b").sha256 == find_bundle(str(bundle.path)).sha256 == bundle.sha256


def test_an_unknown_name_lists_those_that_ship(bundle, monkeypatch):
    monkeypatch.setattr("common.bundle.pretrained", lambda: bundle.path.parent)
    with pytest.raises(BundleError, match=r"'nonesuch'.*: b$"):
        find_bundle("nonesuch")


def test_the_cache_is_where_the_environment_says(tmp_path, monkeypatch):
    monkeypatch.setenv("DREAMFLEET_CACHE", str(tmp_path))
    assert default_cache() == tmp_path
    monkeypatch.delenv("DREAMFLEET_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache() == tmp_path / "dreamfleet"
