"""Files from untrusted sources, damaged in thousands of ways, or claiming far more than they hold.

Each is read, or is a one-line error, in bounded memory and time. Tests task_options.py and common/files/archives.py."""

import hashlib
import io
import json
import os
import random
import re
import struct
import subprocess
import sys
import warnings
import zipfile
from itertools import product
from pathlib import Path

import numpy as np
import onnx
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
from dreamfleet.common.schema.validation import to_plain
from tests.support.bundles import npy, npy_header, parts_of
from tests.support.mutations import archives, mutate, packed, reworded
from tests.support.processes import DEADLINE, ROOT

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


MOST = 600 << 10  # KiB of memory at the peak: twice what an archive may unpack to
BUNDLE = Bundle.open(ROOT / "tests" / "fixtures" / "small.zip")
ABOUT = {"format": 1, "shape": {"features": 4, "actions": 2}, "task": "gym:X-v0", "bundle": "", "provenance": {}}
READ = """
import json, sys
from pathlib import Path
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.worker.worlds.trained_agent import TrainedAgent
from dreamfleet.common.errors import DreamfleetError
said = {}
for path in map(Path, sys.argv[1:]):
    for read in (Bundle.open, Controller.load, TrainedAgent.load):
        try:
            read(path)
        except DreamfleetError as error:
            said.setdefault(path.name, []).append(str(error))
peak = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(json.dumps([said, peak]))
"""


def small(members):
    return packed(members, zipfile.ZIP_DEFLATED)


def controller(parameters):
    return small({"about.npy": npy(np.array(json.dumps(ABOUT))), "parameters.npy": parameters})


def false_length():
    """A member whose declared length is 40 bytes, and which unpacks to 300 MiB."""
    whole = npy_header("(10,)") + bytes(300 << 20)
    return controller(whole).replace(struct.pack("<I", len(whole)), struct.pack("<I", len(whole) - (300 << 20)))


def overlapping():
    """26 entries of the directory for one member of 200 MiB."""
    data = small({"a": bytes(200 << 20)})
    end = data.rindex(b"PK\5\6")
    (start,) = struct.unpack_from("<I", data, end + 16)
    entry = data[start:end]
    directory = b"".join(entry[:46] + bytes([97 + each]) + entry[47:] for each in range(26))
    tail = struct.pack("<IHHHHIIH", 0x06054B50, 0, 0, 26, 26, len(directory), start, 0)
    return data[:start] + directory + tail


def nested():
    inner = small({"a.zip": bytes(250 << 20)})
    return small({f"{each}.zip": inner for each in range(60)})


def latents():
    width = BUNDLE.manifest.latent
    count = (200 << 20) // (4 * width)
    array = npy_header(f"({count}, 2, {width})", "<f2") + bytes(4 * count * width)
    return bundle_with(**{"initial_latents.npy": array})


def external_weights():
    model = onnx.load_from_string(BUNDLE.read("encoder.onnx"))
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    place = tensor.external_data.add()
    place.key, place.value = "location", "../../../../etc/passwd"
    return bundle_with(**{"encoder.onnx": model.SerializeToString()})


def bundle_with(**changed):
    """A packed bundle with other parts and their right hashes."""
    parts = parts_of(BUNDLE) | changed
    hashes = {name: hashlib.sha256(data).hexdigest() for name, data in parts.items()}
    return small({"manifest.json": json.dumps({**to_plain(BUNDLE.manifest), "parts": hashes}), **parts})


def paths_and_links():
    link = zipfile.ZipInfo("link")
    link.external_attr = 0o120777 << 16
    return small({"/etc/evil": b"x", "../../evil": b"x", link: "/etc/passwd"})


NAMED = {  # what the refusal names
    false_length: "false_length",
    overlapping: "5200",
    nested: "manifest.json",
    latents: "initial_latents.npy",
    external_weights: "encoder.onnx",
    paths_and_links: "manifest.json",
}


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
def test_bombs_cost_little_and_each_is_refused_in_one_line(tmp_path):
    named = {make.__name__: datum for make, datum in NAMED.items()} | {"sparse": "268435456"}
    for make in NAMED:
        (tmp_path / make.__name__).write_bytes(make())
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(1 << 40)
    command = [sys.executable, "-c", READ, *(tmp_path / name for name in named)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE, check=True, cwd=tmp_path)
    said, peak = json.loads(done.stdout)
    assert {name: len(texts) for name, texts in said.items()} == dict.fromkeys(named, 3)
    assert not [text for texts in said.values() for text in texts if "\n" in text]
    assert [name for name, datum in named.items() if datum not in " ".join(said[name])] == []
    assert peak < MOST
    assert {each.name for each in tmp_path.rglob("*")} == named.keys()


def test_a_small_zip64_is_refused_for_what_it_is(tmp_path):
    path = tmp_path / "small.npz"
    data = packed({"a.npy": npy(np.zeros(3))})
    end = data.rindex(b"PK\5\6")
    path.write_bytes(data[:end] + b"PK\6\7" + bytes(16) + data[end:])
    with pytest.raises(DamagedArchiveError, match="4"):
        read_arrays(path, ArchiveLimits(1 << 20))
