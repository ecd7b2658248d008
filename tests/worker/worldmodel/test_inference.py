import os
import subprocess
import sys

import pytest

from dreamfleet.common.artifacts.bundle import POLICY, write_bundle
from dreamfleet.common.errors import BundleError
from dreamfleet.worker.worldmodel.inference import open_part


def test_the_runtime_keeps_no_identifier_and_reports_nothing(tmp_path):
    surroundings = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    words = [sys.executable, "-c", "import dreamfleet.worker.worldmodel.inference, onnxruntime"]
    subprocess.run(words, env={**surroundings, "HOME": str(tmp_path)}, check=True)
    assert not list(tmp_path.rglob("*onnxruntime*"))


def test_a_part_that_is_no_graph_is_an_error_of_the_bundle(random_bundle, tmp_path):
    parts = {name: random_bundle.read(name) for name in random_bundle.manifest.parts}
    broken = write_bundle(tmp_path / "broken.zip", random_bundle.manifest, {**parts, POLICY: b"no graph"})
    with pytest.raises(BundleError, match=r"policy\.onnx"):
        open_part(broken, POLICY)
