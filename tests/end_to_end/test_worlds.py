"""World models of another world than the first: made, evolved in, judged, recorded, made anew in rounds.
Tests worker/dream/task.py and worker/worlds/gym/pixels.py."""

import json

import pytest

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.runs.run_folder import open_run
from tests.support.dreams import write_bundle_of
from tests.support.pixel_world import DODGE, DODGE_TASK, MODULE
from tests.support.same_bits import check_replay, evolve

EPISODES = 2
TRUSTED = ("--trust", MODULE)


@pytest.mark.slow
def test_a_run_dreams_in_a_bundles_world_and_is_replayed_to_the_same_bits(processes, tmp_path):
    bundle = write_bundle_of("choices", tmp_path / "b.zip")
    settings = (
        "--preset", "pixels", "--bundle", bundle.path, "--population", 6, "--episodes", EPISODES, "--horizon", 60,
        "--generations", 3, "--evaluate-every", 1, "--evaluation-episodes", 2, "--confirm-episodes", 2,
        "--variant", "decide_every=2", "--end", "0.999",
    )  # fmt: skip
    assert any(evolve(processes, "own", 2, *settings, task=DODGE_TASK).fitness), "somebody lived"
    with open_run(processes.runs, "own") as run:
        assert (run.spec.end, run.spec.version) == ("0.999", 11)
        assert (run.spec.task, run.settings.controller.actions) == ("dream", 3)
    check_replay(processes, "own", "1/2", EPISODES, *TRUSTED, call=processes.call)
    processes.printed("evaluate", "--controller", "own", "--runs-dir", processes.runs, "--episodes", 1, *TRUSTED)


SMALL = {
    "vae": "--updates 3 --batch 8 --set latent=4 channels=2,2,2,2 validate_every=1",
    "mdnrnn": "--updates 3 --batch 2 --set latent=4 hidden=4 validate_every=1",
    "bundle": "--end 0.9 --recorded 8",
}
LAYERS = tuple(word for name, text in SMALL.items() for word in (f"--{name}-flags", text))
SHORT = "--generations 2 --population 4 --episodes 1 --horizon 20 --evaluate-every 1 --evaluation-episodes 1"


@pytest.mark.slow
def test_a_gymnasium_world_goes_from_drives_to_a_video(processes, tmp_path):
    def call(*words):
        return processes.printed(*words, *TRUSTED)

    data, film = tmp_path / "data", tmp_path / "drive.mp4"
    made = call("pipeline", "--data", data, "--task", DODGE, "--scale", "0.02", "--jobs", 1, *LAYERS, "--yes",
                "--json")  # fmt: skip
    bundle = Bundle.open(data / "pixels.zip")
    assert json.loads(made)["stages"]["bundle"]["sha256"] == bundle.sha256
    facts = bundle.manifest.world
    assert (bundle.manifest.task, facts.reward.source, facts.end.at) == (DODGE, "survival", 0.9)
    words = (*SHORT.split(), "--preset", "pixels", "--confirm-episodes", 0, "--bundle", bundle.path)
    evolve(processes, "dodge", 1, *words, task=DODGE)
    run = ("--controller", "dodge", "--runs-dir", processes.runs)
    judged = json.loads(call("evaluate", *run, "--episodes", 2, "--jobs", 1, "--json"))
    assert (judged["world"], len(judged["drives"])) == (DODGE, 2)
    call("record", *run, "--steps", 20, "--out", film)
    assert film.stat().st_size > 1000
    lives = json.loads(call("inspect", bundle.path, "--survival", "--episodes", 4, "--json"))
    assert "held" in json.dumps(lives)
    call("inspect", bundle.path, "--out", tmp_path / "page", "--steps", 20)
    assert (tmp_path / "page" / "index.html").exists()


@pytest.mark.long
def test_rounds_of_a_gymnasium_world_learn_from_drives_of_its_own_controllers(processes):
    data = processes.folder / "data"
    out = processes.printed(
        "iterate", "--data", data, "--task", DODGE, "--rounds", 2, "--drives", 6, "--own-drives", 2, "--means", 1,
        *LAYERS, "--vae-updates", 2, "--mdnrnn-updates", 2, "--gate-lives", 4, "--gate-drives", 0, "--gate-losses", 0,
        "--run-flags", f"{SHORT} --confirm-episodes 0", "--jobs", 1, "--local", 1, *TRUSTED, "--json",
    )  # fmt: skip
    rounds = json.loads(out)["rounds"]
    assert [each["drives"] for each in rounds] == [6, 8]
    for number in (1, 2):
        bundle = Bundle.open(data / "rounds" / f"{number:02d}" / f"round-{number}.zip")
        assert (bundle.manifest.task, bundle.manifest.world.end.at) == (DODGE, 0.9)
        assert bundle.manifest.provenance["drivers"].get("controller", 0) == 2 * (number - 1)
    assert json.loads((data / "rounds" / "02" / "gate.json").read_text())
