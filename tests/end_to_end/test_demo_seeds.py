"""Evolution gets somewhere whatever the seed: half an hour of two cores, `make long`."""

import numpy as np
import pytest

from dreamfleet.common.runs.run_folder import open_run

pytestmark = [pytest.mark.long, pytest.mark.timeout(900)]


def improvement(run):
    """Last three generations over the first three, in standard errors of the difference of their candidates' means."""
    generations = len(run.history())
    fitness = np.array([[run.fitness(g, i) for i in range(run.settings.population)] for g in range(generations)])
    first, last = fitness[:3].ravel(), fitness[-3:].ravel()
    error = np.sqrt(first.var(ddof=1) / len(first) + last.var(ddof=1) / len(last))
    return (last.mean() - first.mean()) / error


@pytest.mark.parametrize("seed", [1, 2, 3, 4, 5])
def test_the_demo_improves_on_zero_parameters_by_two_standard_errors(processes, seed):
    code, out, err = processes.call(
        "demo", "--run", "demo", "--runs-dir", processes.runs, "--seed", seed, "--port", processes.port, "--tracks", 1,
        "--dream-minutes", 0,
        timeout=800,
    )  # fmt: skip
    assert code == 0, out + err
    with open_run(processes.runs, "demo") as run:
        assert improvement(run) > 2
        assert all((run.path / name).stat().st_size for name in ("controller.npz", "fitness.png", "drive.mp4"))
