"""A controller and a world model of another project: judged, evolved further, recorded and dreamt."""

import json

import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.runs.run_folder import open_run
from tests.support import checkpoint_files


@pytest.mark.slow
def test_a_run_goes_on_from_a_controller_of_ctallec_and_another_in_its_dream(processes, tmp_path):
    imported = tmp_path / "exp_dir"
    checkpoint_files.write_checkpoints(imported, checkpoint_files.random_weights())
    world, controller = tmp_path / "world.zip", tmp_path / "controller.npz"
    for command in ((imported, "--out", world), (imported / "ctrl", "--bundle", world, "--out", controller)):
        found = processes.call("import", *command)
        assert found[0] == 0, found
    few = ("--population", 4, "--episodes", 1, "--horizon", 5, "--evaluate-every", 0, "--generations", 1)
    coordinator = processes.coordinator("--bundle", world, "--init", controller, *few)
    processes.worker("--exit-when-done")
    assert coordinator.finish()[0] == 0
    with open_run(processes.runs, "test") as run:
        evolved = Controller.load(run.controller_path)
    assert evolved.variant.actions == "linear"
    replayed = processes.call("verify", "candidate", "test", "--candidate", "0/1", "--runs-dir", processes.runs)
    assert replayed[0] == 0, replayed
    judged = processes.call("evaluate", "--controller", controller, "--bundle", world, "--episodes", 1, "--json")
    assert judged[0] == 0, judged
    assert isinstance(json.loads(judged[1])["mean"], float), judged
    dreamt = ("--task", "dream", "--bundle", world, "--variant", "actions=linear")
    coordinator = processes.coordinator(*dreamt, *few, name="dreamt")
    processes.worker("--run", "dreamt", "--exit-when-done")
    assert coordinator.finish()[0] == 0
