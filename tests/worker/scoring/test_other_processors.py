"""Hosts of different processors are of one class with a world model of eight bits."""

import os
import platform
import subprocess
import sys

import pytest

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.worker.addons.bundles.eight_bits import write_eight_bit_bundle

PROGRAM = """
import sys
from dreamfleet import Scorer, TaskSpec, find_bundle, find_controller
bundle = find_bundle(sys.argv[1])
for task in ("car-racing", "dream"):
    scorer = Scorer(TaskSpec(task, bundle.sha256, horizon=20, patience=0), bundle)
    print(task, scorer.host_class, scorer.score("score", find_controller("tiny").parameters, seed=2**20))
"""


def output_of(bundle, *emulator):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "SDL_VIDEODRIVER": "dummy"}
    command = [*emulator, os.path.realpath(sys.executable), "-W", "ignore", "-c", PROGRAM, str(bundle.path)]
    return subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout.splitlines()


@pytest.mark.slow
@pytest.mark.needs_programs("qemu-x86_64")
@pytest.mark.skipif(platform.machine() != "x86_64", reason="emulates another x86 processor")
def test_class_and_score_are_those_of_a_processor_without_avx512(tmp_path):
    rounded = write_eight_bit_bundle(find_bundle("tiny"), tmp_path / "rounded.zip")
    here = output_of(rounded)
    assert [line.split()[0] for line in here] == ["car-racing", "dream"]
    assert output_of(rounded, "qemu-x86_64", "-cpu", "Haswell") == here
