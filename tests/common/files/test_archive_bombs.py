"""Small files that claim, or unpack to, far more than they hold: one line, in bounded memory and time.
Tests archives.py."""

import hashlib
import json
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import onnx
import pytest

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.files.archives import ArchiveLimits, DamagedArchiveError, read_arrays
from dreamfleet.common.schema.validation import to_plain
from tests.support.bundles import npy
from tests.support.processes import DEADLINE, ROOT

MOST = 600 << 10  # KiB of memory at the peak: twice what an archive may unpack to
ABOUT = {"format": 1, "shape": {"features": 4, "actions": 2}, "task": "gym:X-v0", "bundle": "", "provenance": {}}
READ = """
import sys
from pathlib import Path
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.trained_agent import TrainedAgent
from dreamfleet.common.errors import DreamfleetError
for read in (Bundle.open, Controller.load, TrainedAgent.load):
    try:
        read(Path(sys.argv[1]))
        print("opened")
    except DreamfleetError as error:
        print(error)
print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


def header(shape, kind="<f4"):
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def packed(path, *members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members:
            archive.writestr(name, data)


def controller(path, parameters):
    packed(path, ("about.npy", npy(np.array(json.dumps(ABOUT)))), ("parameters.npy", parameters))


def huge_shape(path):
    controller(path, header("(1000000000000,)") + bytes(40))


def many_zeros(path):
    controller(path, header(f"({60 << 18},)") + bytes(60 << 20))


def false_length(path):
    """A member whose declared length is 40 bytes, and which unpacks to 300 MiB."""
    whole = header("(10,)") + bytes(300 << 20)
    controller(path, whole)
    path.write_bytes(
        path.read_bytes().replace(struct.pack("<I", len(whole)), struct.pack("<I", len(whole) - (300 << 20)))
    )


def overlapping(path):
    """26 entries of the directory for one member of 200 MiB."""
    packed(path, ("a", bytes(200 << 20)))
    data = path.read_bytes()
    end = data.rindex(b"PK\5\6")
    (start,) = struct.unpack_from("<I", data, end + 16)
    entry = data[start:end]
    directory = b"".join(entry[:46] + bytes([97 + each]) + entry[47:] for each in range(26))
    tail = struct.pack("<IHHHHIIH", 0x06054B50, 0, 0, 26, 26, len(directory), start, 0)
    path.write_bytes(data[:start] + directory + tail)


def nested(path):
    packed(path, ("a.zip", bytes(250 << 20)))
    inner = path.read_bytes()
    packed(path, *((f"{each}.zip", inner) for each in range(60)))


def latents(path):
    small = Bundle.open(ROOT / "tests" / "fixtures" / "small.zip")
    width = small.manifest.latent
    count = (200 << 20) // (4 * width)
    parts = {name: small.read(name) for name in small.manifest.parts}
    parts["initial_latents.npy"] = header(f"({count}, 2, {width})", "<f2") + bytes(4 * count * width)
    rewrite(path, small, parts)


def external_weights(path):
    small = Bundle.open(ROOT / "tests" / "fixtures" / "small.zip")
    parts = {name: small.read(name) for name in small.manifest.parts}
    model = onnx.load_from_string(parts["encoder.onnx"])
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    place = tensor.external_data.add()
    place.key, place.value = "location", "../../../../etc/passwd"
    rewrite(path, small, parts | {"encoder.onnx": model.SerializeToString()})


def rewrite(path, small, parts):
    """A packed bundle with other parts and their right hashes."""
    hashes = {name: hashlib.sha256(data).hexdigest() for name, data in parts.items()}
    packed(path, ("manifest.json", json.dumps({**to_plain(small.manifest), "parts": hashes})), *parts.items())


def paths_and_links(path):
    packed(path, ("/etc/evil", b"x"), ("../../evil", b"x"))
    link = zipfile.ZipInfo("link")
    link.external_attr = 0o120777 << 16
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(link, "/etc/passwd")


def sparse(path):
    with path.open("wb") as file:
        file.truncate(1 << 40)


NAMED = {  # what the refusal names
    huge_shape: "parameters",
    many_zeros: "10",
    false_length: "bomb",
    overlapping: "5200",
    nested: "manifest.json",
    latents: "initial_latents.npy",
    external_weights: "encoder.onnx",
    paths_and_links: "manifest.json",
    sparse: "268435456",
}


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
@pytest.mark.parametrize("make", NAMED, ids=lambda make: make.__name__)
def test_a_bomb_costs_little_and_is_refused_in_one_line(tmp_path, make):
    path = tmp_path / "bomb"
    make(path)
    before = sorted(each.name for each in tmp_path.rglob("*"))
    done = subprocess.run(
        [sys.executable, "-c", READ, path], capture_output=True, text=True, timeout=DEADLINE, check=True, cwd=tmp_path
    )
    *said, peak = done.stdout.splitlines()
    assert len(said) == 3
    assert "opened" not in said
    assert NAMED[make] in done.stdout
    assert int(peak) < MOST
    assert sorted(each.name for each in tmp_path.rglob("*")) == before


def test_a_small_zip64_is_refused_for_what_it_is(tmp_path):
    path = tmp_path / "small.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", npy(np.zeros(3)))
    data = path.read_bytes()
    end = data.rindex(b"PK\5\6")
    path.write_bytes(data[:end] + b"PK\6\7" + bytes(16) + data[end:])
    with pytest.raises(DamagedArchiveError, match="4"):
        read_arrays(path, ArchiveLimits(1 << 20))
