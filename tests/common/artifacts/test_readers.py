"""Files from untrusted sources, damaged in thousands of ways: each is read, or is a one-line error.
Tests task_options.py."""

import hashlib
import io
import os
import random
import re
import struct
import sys
import zipfile

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import Bundle, BundleManifest, write_bundle
from dreamfleet.common.artifacts.bundle_store import BundleStore, default_cache, find_bundle
from dreamfleet.common.artifacts.car_racing_variants import FACTS
from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.cli.config import load, read_toml
from dreamfleet.common.errors import BundleError, ControllerError, DreamfleetError, UsageError
from dreamfleet.common.files.archives import ArchiveLimits, DamagedArchiveError, parse_array, read_arrays
from tests.support.bundles import npy
from tests.support.mutations import archives, mutate, packed, reworded

COUNT = 1000
LIMITS = ArchiveLimits(1 << 20)
KINDS = ["<f4", ">f8", "<i8", "|u1", "|b1", "<f2", "<U7"]


@pytest.fixture
def controller(tmp_path):
    path = tmp_path / "c.npz"
    shape = ControllerShape(4, 2, 3)
    parameters = np.zeros(shape.size, np.float32)
    Controller(shape, parameters, "gym:X-v0", "ab" * 32, {"generation": 3}, '{"a": 1}', 2).save(path)
    return path


@pytest.fixture
def bundle(tmp_path):
    graph = b"\x3a\x10\x0a\x0e" + b"\x0a\x01x" * 4 + b"\x12\x00"
    parts = dict.fromkeys(("encoder.onnx", "decoder.onnx", "dream.onnx"), graph)
    parts["initial_latents.npy"] = npy(np.zeros((1, 2, 4), np.float32))
    manifest = BundleManifest(
        "small", "toy", "none", (64, 64, 3), latent=4, hidden=4, actions=3, models={"vae": {"a": 1}}, world=FACTS
    )
    return write_bundle(tmp_path / "small.zip", manifest, parts).path


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(), (0,), (5,), (2, 3), (4, 1, 2)])
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_parse_as_in_numpy(kind, shape, order):
    array = np.asarray(np.arange(np.prod(shape, dtype=int)).reshape(shape).astype(kind), order=order)
    ours, theirs = parse_array(npy(array)), np.load(io.BytesIO(npy(array)))
    assert (ours.dtype, ours.shape, ours.flags.f_contiguous) == (theirs.dtype, theirs.shape, theirs.flags.f_contiguous)
    assert np.array_equal(ours, theirs)
    assert ours.flags.writeable


def header(text):
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


@pytest.mark.parametrize(
    "data",
    [
        npy(np.array([object()])),
        npy(np.zeros(3, [("a", "<f4"), ("b", "<i4")])),
        npy(np.zeros(3, "datetime64[s]")),
        header(b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }\n"),
        header(b"{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }\n"),
        header(b"{'descr': '<f4', 'fortran_order': False, 'shape': (1,), }\n"),
        header(b"{'descr': '<f3', 'fortran_order': False, 'shape': (0,), }\n"),
        header(b"{'descr': '<U0', 'fortran_order': False, 'shape': (5,), }\n"),
        header(b"{'descr': '<f4', 'fortran_order': False, 'shape': (0, 999999999999999999, 99), }\n"),
        header(b"(" * 60_000),
        header(b"{'descr': '<U1', 'fortran_order': False, 'shape': (), }\n") + b"\xff" * 4,
        b"",
        b"\x93NUMPY",
    ],
)
def test_other_arrays_are_refused(data):
    with pytest.raises(DamagedArchiveError):
        parse_array(data)


def bomb(size):
    return packed({"a.npy": npy(np.zeros(size, np.uint8))}, zipfile.ZIP_DEFLATED)


def declaring(size):
    """A member that is shorter than declared."""
    data = bytearray(packed({"a.npy": npy(np.zeros(4))}, zipfile.ZIP_DEFLATED))
    data[data.index(b"PK\1\2") + 24 :][:4] = struct.pack("<I", size)
    place = data.index(b"PK\1\2") + 24
    data[place : place + 4] = struct.pack("<I", size)
    return bytes(data)


def encrypted():
    data = bytearray(packed({"a.npy": npy(np.zeros(4))}))
    for mark, place in ((b"PK\3\4", 6), (b"PK\1\2", 8)):
        data[data.index(mark) + place] |= 1
    return bytes(data)


def twice():
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("a.npy", npy(np.zeros(1)))
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("a.npy", npy(np.ones(1)))
    return buffer.getvalue()


def commented():
    buffer = io.BytesIO(packed({"a.npy": npy(np.zeros(4))}))
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.comment = b"x" * 1000
    return buffer.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        bomb(50 << 20),
        declaring(2**31),
        declaring(1000),
        encrypted(),
        twice(),
        packed({"a.npy": npy(np.zeros(4))}, zipfile.ZIP_BZIP2),
        packed({f"{number}.npy": b"" for number in range(65)}),
        packed({f"{number}.npy": b"" for number in range(5000)}),
        packed({"b.npy": npy(np.zeros(4))}),
        commented(),
    ],
)
def test_an_archive_is_bounded_before_it_is_read(data, watched):
    assert not watched.read(DamagedArchiveError, read_arrays, data, LIMITS, ["a"])


def test_a_zip_bomb_is_refused(bundle, watched):
    with (
        zipfile.ZipFile(bundle, "a", zipfile.ZIP_DEFLATED) as archive,
        archive.open("weights.safetensors", "w") as part,
    ):
        for _ in range(300):
            part.write(bytes(1 << 20))
    with pytest.raises(BundleError, match=r"300.* 256"):
        Bundle.open(bundle)


def damage(whole, path, watched, error, load, seed):
    """Damage a file many times: each version is read, or is a one-line error."""
    read = 0
    for data in archives(whole.read_bytes(), COUNT, seed=seed):
        path.write_bytes(data)
        read += watched.read(error, load, path)
    assert 0 < read < COUNT


def test_damaged_controllers(controller, watched):
    damage(controller, controller.with_name("d.npz"), watched, ControllerError, Controller.load, seed=1)


@pytest.mark.slow
def test_damaged_bundles(bundle, watched):
    damage(bundle, bundle.with_name("d.zip"), watched, BundleError, Bundle.open, seed=2)


@pytest.mark.slow
def test_damaged_settings(tmp_path, watched):
    from dreamfleet.coordinator.settings.config import RunConfig
    from dreamfleet.coordinator.settings.limits import LimitsConfig
    from dreamfleet.coordinator.settings.network import NetworkConfig

    whole = (
        b'connect = ["tcp/h:1"]\n[run]\npopulation = 8\nsigma0 = 0.1\ntask = "gym:A-v0"\nenvironment = ["a=1"]\n'
        b'racing = true\n[limits]\ngenerations = 5\nminutes = 1.5\n[network]\nlisten = ["tcp/h:1"]\n'
    )
    source, path = random.Random(3), tmp_path / "run.toml"

    def read():
        file = read_toml(path, ["run", "limits", "network"], ["connect"])
        for section, name in ((RunConfig, "run"), (LimitsConfig, "limits"), (NetworkConfig, "network")):
            load(section, name, file=file)

    count = 0
    for _ in range(COUNT):
        path.write_bytes(reworded(source, whole) if source.random() < 0.5 else mutate(source, whole, [whole]))
        count += watched.read(DreamfleetError, read)
    assert 0 < count < COUNT


@pytest.mark.slow
def test_damaged_task_options(watched):
    from dreamfleet.coordinator.settings.config import RunConfig
    from dreamfleet.coordinator.settings.freezing import check_normalisation

    whole = b'{"environment": {"a": 1}, "normal": {"mean": [0.5, 1.5], "deviation": [1.0, 2.0]}}'
    source = random.Random(4)

    def read(text):
        RunConfig(task="gym:A-v0", task_options=text).description_options()
        check_normalisation(text, 2)

    count = 0
    for _ in range(COUNT):
        data = reworded(source, whole) if source.random() < 0.5 else mutate(source, whole, [whole])
        count += watched.read(UsageError, read, data.decode(errors="surrogateescape"))
    assert 0 < count < COUNT


@pytest.fixture
def strange(tmp_path):
    """Paths that are not readable regular files."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty").touch()
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "endless").symlink_to("/dev/zero")
    names = [tmp_path / name for name in ("pipe", "folder", "empty", "loop", "endless", "absent")]
    return [*names, tmp_path / ("x" * 5000), tmp_path / "a\0b", tmp_path / "half\ud800", tmp_path / "empty" / "below"]


def test_anything_but_a_regular_file_is_a_one_line_error(strange, watched, tmp_path):
    from dreamfleet.common.runs.lookup import find_controller

    for path in strange:
        assert not watched.read(BundleError, Bundle.open, path)
        assert not watched.read(BundleError, find_bundle, str(path))
        assert not watched.read(ControllerError, Controller.load, path)
        assert not watched.read(ControllerError, find_controller, str(path), tmp_path)
        if path.name != "empty":
            assert not watched.read(UsageError, read_toml, path, [])


def test_a_cache_entry_that_is_not_a_regular_file_is_ignored(tmp_path, bundle, watched):
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


@pytest.mark.parametrize("ending", ["part", "lock"])
def test_links_in_a_cache_are_not_followed(tmp_path, ending):
    (tmp_path / "cache" / "bundles").mkdir(parents=True)
    own = tmp_path / "own"
    own.write_text("mine")
    (tmp_path / "cache" / "bundles" / f"{'ab' * 32}.{ending}").symlink_to(own)
    from dreamfleet.common.files.regular_files import open_append

    with pytest.raises((BundleError, OSError)), BundleStore(tmp_path / "cache").lock_download("ab" * 32) as partial:
        open_append(partial)
    assert own.read_text() == "mine"


def test_a_cache_that_is_a_file_is_a_one_line_error(tmp_path):
    (tmp_path / "cache").touch()
    store = BundleStore(tmp_path / "cache")
    assert store.find("ab" * 32) is None
    with pytest.raises(BundleError, match=re.escape(str(tmp_path / "cache"))), store.lock_download("ab" * 32):
        pass


@pytest.mark.skipif(sys.platform != "linux", reason="a user without an entry")
def test_a_user_without_a_home_folder_has_no_default_cache(monkeypatch):
    for name in ("HOME", "DREAMFLEET_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "getuid", lambda: 2**31 - 7)
    with pytest.raises(UsageError):
        default_cache()
