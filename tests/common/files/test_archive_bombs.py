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
from tests.support.bundles import npy, npy_header, parts_of
from tests.support.mutations import packed
from tests.support.processes import DEADLINE, ROOT

MOST = 600 << 10  # KiB of memory at the peak: twice what an archive may unpack to
BUNDLE = Bundle.open(ROOT / "tests" / "fixtures" / "small.zip")
ABOUT = {"format": 1, "shape": {"features": 4, "actions": 2}, "task": "gym:X-v0", "bundle": "", "provenance": {}}
READ = """
import json, sys
from pathlib import Path
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.trained_agent import TrainedAgent
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
