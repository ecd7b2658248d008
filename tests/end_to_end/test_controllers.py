"""A run whose controllers are not the linear one on latent and hidden state: every verb knows."""

import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.runs.run_folder import open_run


@pytest.mark.slow
def test_a_hidden_controller_on_the_latent_alone_is_evolved_replayed_and_judged(processes, random_bundle):
    coordinator = processes.coordinator(
        "--bundle", random_bundle.path, "--controller", "hidden", "--hidden-units", 4, "--features", "z",
        "--population", 4, "--episodes", 1, "--horizon", 5, "--evaluate-every", 0, "--generations", 2,
    )  # fmt: skip
    processes.worker("--exit-when-done")
    assert coordinator.finish()[0] == 0
    with open_run(processes.runs, "test") as run:
        shape, path = run.settings.controller, run.controller_path
        assert run.candidate(1, 0).shape == (shape.size,)
    assert (shape.features, shape.hidden, shape.size) == (32, 4, 4 * 33 + 3 * 5)
    assert Controller.load(path).shape == shape
    replayed = processes.call("verify", "candidate", "test", "--candidate", "1/2", "--runs-dir", processes.runs)
    assert replayed[0] == 0, replayed
    judged = processes.call(
        "evaluate", "--controller", path, "--bundle", random_bundle.path, "--episodes", 1, "--jobs", 1, "--json"
    )
    assert judged[0] == 0, judged
