"""This installation as a wheel, and the name of its environment."""

import base64
import csv
import hashlib
import io
import zipfile
from importlib.metadata import version

import pytest

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.coordinator.addons.spawn.parcel import Parcel, Wheel, pack_wheel, pins


@pytest.mark.slow
def test_the_wheel_matches_its_record_and_is_reproducible():
    wheel = pack_wheel(native=True)
    assert wheel == pack_wheel(native=True)
    with zipfile.ZipFile(io.BytesIO(wheel.data)) as archive:
        names = archive.namelist()
        (record,) = (name for name in names if name.endswith(".dist-info/RECORD"))
        rows = list(csv.reader(io.StringIO(archive.read(record).decode())))
        for name, digest, size in rows[:-1]:
            data = archive.read(name)
            found = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
            assert (digest, int(size)) == (f"sha256={found}", len(data))
        assert [row[0] for row in rows] == names
        assert {"dreamfleet/worker/service/worker.py", "dreamfleet/common/pretrained/tiny.zip"} <= set(names)
        assert not any("__pycache__" in name or name.endswith(".pyc") for name in names)
        assert b"dreamfleet.worker.verbs.worker" in archive.read(record.replace("RECORD", "entry_points.txt"))


def test_for_another_processor_it_holds_python_alone():
    wheel = pack_wheel(native=False)
    assert wheel.name == f"dreamfleet-{version('dreamfleet')}-py3-none-any.whl"
    with zipfile.ZipFile(io.BytesIO(wheel.data)) as archive:
        assert not any(name.endswith(".so") for name in archive.namelist())


def test_pins_are_the_versions_installed_here():
    lines = pins().splitlines()
    assert {f"{name}=={version(name)}" for name in ("numpy", "onnxruntime")} <= set(lines)
    assert not any(line.startswith(("torch", "matplotlib")) for line in lines)


def test_environments_that_differ_have_different_names(tmp_path):
    (tmp_path / "numpy-2.0-cp311-cp311-manylinux_2_28_x86_64.whl").write_bytes(b"1")
    wheel, other = Wheel("a.whl", b"a"), Wheel("a.whl", b"b")
    first, same = Parcel(wheel, "numpy==1"), Parcel(wheel, "numpy==1")
    differing = first, Parcel(other, "numpy==1"), Parcel(wheel, "numpy==2"), Parcel(wheel, "numpy==1", tmp_path)
    made = [each.environment((3, 11), "x86_64") for each in differing]
    made += [first.environment((3, 12), "x86_64"), first.environment((3, 11), "aarch64")]
    assert len(set(made)) == len(made)
    assert made[0] == same.environment((3, 11), "x86_64")


def test_a_wheelhouse_of_another_processor_is_refused_before_it_is_sent(tmp_path):
    (tmp_path / "numpy-2.0-cp311-cp311-manylinux_2_28_x86_64.whl").touch()
    (tmp_path / "cma-4.5-py3-none-any.whl").touch()
    parcel = Parcel(Wheel("a.whl", b""), "", tmp_path)
    parcel.check_fits("x86_64")
    with pytest.raises(DreamfleetError, match="aarch64"):
        parcel.check_fits("aarch64")
