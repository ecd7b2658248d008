"""The demonstration, seconds long."""

import pytest

from dreamfleet.common.controller import Controller
from dreamfleet.common.runs import open_run

pytestmark = pytest.mark.timeout(300)


def test_it_dreams_drives_judges_plots_and_records(processes, random_bundle):
    code, out, err = processes.call(
        "demo", "--run", "demo", "--runs-dir", processes.runs, "--port", processes.port, "--bundle", random_bundle.path,
        "--dream-minutes", 0.02, "--minutes", 0.02, "--horizon", 30, "--tracks", 1, "--population", 4, timeout=250,
    )  # fmt: skip
    assert code == 0, err
    with open_run(processes.runs, "demo-dream") as dream, open_run(processes.runs, "demo") as real:
        assert dream.settings.task.task == "dream"
        assert real.settings.task.task == "car-racing"
        assert dream.history()
        assert real.history()
        assert dream.evaluations()
        assert Controller.load(real.controller_path).bundle == random_bundle.sha256
        best = max((real, dream), key=lambda run: max(each.mean for each in run.evaluations())).name
    assert f"run {best}'s" in out.replace("\n", " ")
    for made in (f"{best}/drive.mp4", "demo/fitness.png", "demo-dream/fitness.png"):
        assert (processes.runs / made).stat().st_size > 1000
    assert "evolving in the dream" in out
