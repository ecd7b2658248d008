"""CarRacing where Box2D and pygame cannot be imported: the same scores, and reports say who judged.
Tests environment.py, native_check.py, task.py, worker/addons/recording/canvas.py and worker/addons/health.py."""

import json
import os
import subprocess
import sys

import pytest

from dreamfleet.worker.worlds.car_racing.environment import is_native_available

if not is_native_available():
    pytest.skip("no native module was built", allow_module_level=True)

HIDING = """
from importlib.machinery import PathFinder
found = PathFinder.find_spec
def find_spec(name, path=None, target=None):
    return None if name.partition(".")[0] in ("Box2D", "pygame") else found(name, path, target)
PathFinder.find_spec = staticmethod(find_spec)
"""
DRIVING = """
import sys
import numpy as np
from dreamfleet import find_bundle
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.worlds.car_racing import native_check
from dreamfleet.worker.worlds.car_racing.task import CarRacingTask
task, assignment = CarRacingTask(), Assignment.of("car-racing", find_bundle("tiny"))
judge = task.make_evaluation_environment(assignment, "rgb_array")
judge.reset(seed=1)
print(task.world_of(assignment).judge, judge.render().shape, judge.step(np.ones(3, np.float32))[1], sep="|")
assert not {"Box2D", "pygame"} & set(sys.modules)
native_check.native_is_exact.cache_clear()
native_check.TRUTHS["discrete"] = "another " * 12
try:
    task.make_environment(assignment)
except native_check.DreamfleetError:
    print("refused")
"""


def run_hidden(folder, *words):
    """What a process prints that finds neither package."""
    (folder / "sitecustomize.py").write_text(HIDING)
    seen = {**os.environ, "PYTHONPATH": str(folder)}
    return subprocess.run([sys.executable, *words], env=seen, check=True, capture_output=True, text=True).stdout


def test_the_native_core_drives_and_judges_alone_unless_it_computes_something_else(tmp_path):
    first, second = run_hidden(tmp_path, "-c", DRIVING).splitlines()
    judge, shape, reward = first.split("|")
    assert judge != "gymnasium"
    assert (shape, second) == ("(576, 576, 3)", "refused")
    assert float(reward) > 0


def test_such_a_host_can_be_a_worker(tmp_path):
    report = json.loads(run_hidden(tmp_path, "-m", "dreamfleet", "doctor", "--role", "worker", "--json"))
    missing = {each["name"] for each in report["checks"] if not each["ok"] and each["role"] == "worker"}
    assert missing == {"box2d", "pygame-ce"}


@pytest.mark.slow
def test_a_report_has_the_same_scores_and_another_judge_and_a_drive_is_filmed(tmp_path):
    words = ("-m", "dreamfleet", "evaluate", "--controller", "tiny", "--episodes", "1", "--json")
    alone = json.loads(run_hidden(tmp_path, *words))
    judged = json.loads(subprocess.run([sys.executable, *words], check=True, capture_output=True, text=True).stdout)
    assert alone["drives"] == judged["drives"]
    assert (judged["judge"], alone["judge"] != "gymnasium") == ("gymnasium", True)
    video = tmp_path / "drive.mp4"
    run_hidden(tmp_path, "-m", "dreamfleet", "record", "--controller", "tiny", "--steps", "9", "--out", str(video))
    assert video.stat().st_size > 1000
