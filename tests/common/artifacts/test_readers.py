"""Files from untrusted sources, damaged in thousands of ways: each is read, or is a one-line error.
Tests task_options.py."""

import hashlib
import io
import os
import random
import re
import struct
import sys
import warnings
import zipfile
from itertools import product

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import Bundle, BundleManifest, write_bundle
from dreamfleet.common.artifacts.bundle_store import BundleStore, default_cache, find_bundle
from dreamfleet.common.artifacts.car_racing_variants import FACTS
from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.cli.config import load, read_toml
from dreamfleet.common.errors import BundleError, ControllerError, DreamfleetError, UsageError
from dreamfleet.common.files.archives import ArchiveLimits, DamagedArchiveError, parse_array, read_arrays
from dreamfleet.common.files.regular_files import open_append
from dreamfleet.common.runs.lookup import find_controller
from tests.support.bundles import npy, npy_header
from tests.support.mutations import archives, mutate, packed, reworded

COUNT = 1000
LIMITS = ArchiveLimits(1 << 20)


@pytest.fixture
def bundle(tmp_path):
    graph = b"\x3a\x10\x0a\x0e" + b"\x0a\x01x" * 4 + b"\x12\x00"
    parts = dict.fromkeys(("encoder.onnx", "decoder.onnx", "dream.onnx"), graph)
    parts["initial_latents.npy"] = npy(np.zeros((1, 2, 4), np.float32))
    manifest = BundleManifest(
        "small", "toy", "none", (64, 64, 3), latent=4, hidden=4, actions=3, models={"vae": {"a": 1}}, world=FACTS
    )
    return write_bundle(tmp_path / "small.zip", manifest, parts).path


@pytest.mark.parametrize("kind", ["<f4", ">f8", "<i8", "|u1", "|b1", "<f2", "<U7"])
def test_arrays_parse_as_in_numpy(kind):
    for shape, order in product([(), (0,), (5,), (2, 3), (4, 1, 2)], "CF"):
        array = np.asarray(np.arange(np.prod(shape, dtype=int)).reshape(shape).astype(kind), order=order)
        ours, theirs = parse_array(npy(array)), np.load(io.BytesIO(npy(array)))
        assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape)
        assert ours.flags.f_contiguous == theirs.flags.f_contiguous
        assert np.array_equal(ours, theirs)
        assert ours.flags.writeable


@pytest.mark.parametrize(
    "data",
    [
        npy(np.array([object()])),
        npy(np.zeros(3, [("a", "<f4"), ("b", "<i4")])),
        npy(np.zeros(3, "datetime64[s]")),
        *map(npy_header, ("(1000000000000,)", "(-1,)", "(1,)", "(0, 999999999999999999, 99)", "(" * 60_000)),
        npy_header("(0,)", "<f3"),
        npy_header("(5,)", "<U0"),
        npy_header("()", "<U1") + b"\xff" * 4,
        b"",
        b"\x93NUMPY",
    ],
)
def test_other_arrays_are_refused(data):
    with pytest.raises(DamagedArchiveError):
        parse_array(data)


def declaring(size):
    """A member that is shorter than declared."""
    data = bytearray(packed({"a.npy": npy(np.zeros(4))}, zipfile.ZIP_DEFLATED))
    place = data.index(b"PK\1\2") + 24
    data[place : place + 4] = struct.pack("<I", size)
    return bytes(data)


def changed(change):
    buffer = io.BytesIO(packed({"a.npy": npy(np.zeros(4))}))
    with zipfile.ZipFile(buffer, "a") as archive, warnings.catch_warnings(action="ignore"):
        change(archive)
    return buffer.getvalue()


def encrypted():
    data = bytearray(packed({"a.npy": npy(np.zeros(4))}))
    for mark, place in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        data[data.index(mark) + place] |= 1
    return bytes(data)


@pytest.mark.parametrize(
    "data",
    [
        packed({"a.npy": npy(np.zeros(50 << 20, np.uint8))}, zipfile.ZIP_DEFLATED),  # a bomb
        declaring(2**31),
        declaring(1000),
        encrypted(),
        changed(lambda archive: archive.writestr("a.npy", npy(np.ones(1)))),  # twice
        changed(lambda archive: setattr(archive, "comment", b"x" * 1000)),
        packed({"a.npy": npy(np.zeros(4))}, zipfile.ZIP_BZIP2),
        packed({f"{number}.npy": b"" for number in range(65)}),
        packed({f"{number}.npy": b"" for number in range(5000)}),
        packed({"b.npy": npy(np.zeros(4))}),
    ],
)
def test_an_archive_is_bounded_before_it_is_read(data, watched):
    assert not watched.read(DamagedArchiveError, read_arrays, data, LIMITS, ["a"])


def check_all(watched, error, read, damaged):
    """Each of many damaged versions is read, or is a one-line error."""
    found = [watched.read(error, read, each) for each in damaged]
    assert 0 < sum(found) < len(found)


def damaged_files(whole, path, seed):
    for data in archives(whole.read_bytes(), COUNT, seed=seed):
        path.write_bytes(data)
        yield path


def damaged_texts(whole, seed):
    source = random.Random(seed)
    for _ in range(COUNT):
        yield reworded(source, whole) if source.random() < 0.5 else mutate(source, whole, [whole])


def test_damaged_controllers(tmp_path, watched):
    shape = ControllerShape(4, 2, 3)
    parameters, path = np.zeros(shape.size, np.float32), tmp_path / "c.npz"
    Controller(shape, parameters, "gym:X-v0", "ab" * 32, {"generation": 3}, '{"a": 1}', 2).save(path)
    check_all(watched, ControllerError, Controller.load, damaged_files(path, tmp_path / "d.npz", 1))


@pytest.mark.slow
def test_damaged_bundles(bundle, watched):
    check_all(watched, BundleError, Bundle.open, damaged_files(bundle, bundle.with_name("d.zip"), 2))


@pytest.mark.slow
def test_damaged_settings(tmp_path, watched):
    from dreamfleet.coordinator.settings.config import RunConfig
    from dreamfleet.coordinator.settings.limits import LimitsConfig
    from dreamfleet.coordinator.settings.network import NetworkConfig

    whole = (
        b'connect = ["tcp/h:1"]\n[run]\npopulation = 8\nsigma0 = 0.1\ntask = "gym:A-v0"\nenvironment = ["a=1"]\n'
        b'racing = true\n[limits]\ngenerations = 5\nminutes = 1.5\n[network]\nlisten = ["tcp/h:1"]\n'
    )
    path = tmp_path / "run.toml"

    def read(data):
        path.write_bytes(data)
        file = read_toml(path, ["run", "limits", "network"], ["connect"])
        for section, name in ((RunConfig, "run"), (LimitsConfig, "limits"), (NetworkConfig, "network")):
            load(section, name, file=file)

    check_all(watched, DreamfleetError, read, damaged_texts(whole, 3))


@pytest.mark.slow
def test_damaged_task_options(watched):
    from dreamfleet.coordinator.settings.config import RunConfig
    from dreamfleet.coordinator.settings.freezing import check_normalisation

    whole = b'{"environment": {"a": 1}, "normal": {"mean": [0.5, 1.5], "deviation": [1.0, 2.0]}}'

    def read(data):
        text = data.decode(errors="surrogateescape")
        RunConfig(task="gym:A-v0", task_options=text).description_options()
        check_normalisation(text, 2)

    check_all(watched, UsageError, read, damaged_texts(whole, 4))


def test_anything_but_a_regular_file_is_a_one_line_error(watched, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty").touch()
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "endless").symlink_to("/dev/zero")
    strange = ("pipe", "folder", "empty", "loop", "endless", "absent", "x" * 5000, "a\0b", "half\ud800", "empty/below")
    for path in map(tmp_path.joinpath, strange):
        assert not watched.read(BundleError, Bundle.open, path)
        assert not watched.read(BundleError, find_bundle, str(path))
        assert not watched.read(ControllerError, Controller.load, path)
        assert not watched.read(ControllerError, find_controller, str(path), tmp_path)
        if path.name != "empty":
            assert not watched.read(UsageError, read_toml, path, [])


def test_a_cache_entry_that_is_not_a_regular_file_is_ignored_and_a_link_is_not_followed(tmp_path, bundle):
    sha256 = hashlib.sha256(bundle.read_bytes()).hexdigest()
    store, entry = BundleStore(tmp_path / "cache"), tmp_path / "cache" / "bundles" / f"{sha256}.zip"
    entry.parent.mkdir(parents=True)
    os.mkfifo(entry)
    assert store.find(sha256) is None
    entry.unlink()
    entry.write_bytes(bundle.read_bytes()[:-1])
    assert store.find(sha256) is None
    assert not entry.exists()
    entry.mkdir()
    assert store.find(sha256) is None
    with store.lock_download(sha256) as partial:
        partial.write_bytes(bundle.read_bytes())
        with pytest.raises(BundleError, match="Is a directory"):
            store.finish_download(sha256)
    own = tmp_path / "own"
    own.write_text("mine")
    for ending in ("part", "lock"):
        link = entry.with_suffix(f".{ending}")
        link.unlink()
        link.symlink_to(own)
        with pytest.raises((BundleError, OSError)), store.lock_download(sha256) as partial:
            open_append(partial)
        assert own.read_text() == "mine"


@pytest.mark.skipif(sys.platform != "linux", reason="a user without an entry")
def test_a_cache_that_is_a_file_or_of_a_user_without_a_home_folder_is_a_one_line_error(tmp_path, monkeypatch):
    (tmp_path / "cache").touch()
    store = BundleStore(tmp_path / "cache")
    assert store.find("ab" * 32) is None
    with pytest.raises(BundleError, match=re.escape(str(tmp_path / "cache"))), store.lock_download("ab" * 32):
        pass
    for name in ("HOME", "DREAMFLEET_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "getuid", lambda: 2**31 - 7)
    with pytest.raises(UsageError):
        default_cache()
