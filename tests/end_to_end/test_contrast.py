"""Two kinds of MDN-RNNs on one small data set, killed in between.
Tests dreamfleet/experiments/contrast/trials.py and dreamfleet/experiments/verbs/contrast.py."""

import json
import signal

import pytest

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.runs.run_folder import open_run
from tests.support.drives import write_encoded_drives
from tests.support.processes import call_here

RUN = (
    "--generations 2 --population 4 --episodes 1 --horizon 10 --evaluate-every 1 --evaluation-episodes 1"
    " --confirm-episodes 0"
)
SMALL = (
    "--mdnrnn-flags", "--updates 3 --batch 2 --set latent=4 hidden=4 validate_every=1", "--run-flags", RUN,
    "--kind", "plain", "", "--kind", "attentive", "--set window=2 attention_units=2", "--local", 1,
)  # fmt: skip


@pytest.fixture
def data(tmp_path):
    return write_encoded_drives(tmp_path / "data")


@pytest.mark.long
def test_a_stopped_contrast_continues_and_compares_the_kinds(processes, data, tmp_path):
    words = ("lab", "contrast", "--data", data, "--out", tmp_path / "out", "--seeds", 1, *SMALL)
    first = processes.start(*words)
    first.wait_for("plain-1")
    first.popen.send_signal(signal.SIGTERM)
    code, _ = first.finish()
    assert code == 130, first.lines

    code, out, err = processes.call(*words, "--json")
    assert code == 0, err
    answer = json.loads(out)
    assert [each["kind"] for each in answer["trials"]] == ["plain", "attentive"]
    for each in answer["trials"]:
        model = Bundle.open(tmp_path / "out" / f"{each['kind']}-1" / f"{each['kind']}-1.zip").manifest
        assert model.models["mdnrnn"]["window"] == (2 if each["kind"] == "attentive" else 0)
        assert each["quality"]["nats_per_dimension"] == model.provenance["quality"]["nats_per_dimension"]
        with open_run(tmp_path / "out" / "runs", f"{each['kind']}-1") as run:
            assert run.ended == "2 generations"
            assert each["score"] == max(evaluation.mean for evaluation in run.evaluations())
    code, _, err = processes.call(*words, "--run-flags", "--generations 9")
    assert (code, "run_flags" in err) == (2, True), err


def test_what_cannot_be_contrasted_is_said_at_once(tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    code, _, err = call_here("lab", "contrast", "--data", empty, "--out", tmp_path / "out")
    assert (code, str(empty) in err) == (1, True), err
    for flags, why in (
        ("--sigma0 0.1", "--generations"),
        ("--generations 2 --seed 4", "--seed"),
        ("--generations 2 --population 1", "--population"),
    ):
        code, _, err = call_here("lab", "contrast", "--data", empty, "--out", tmp_path / "out", "--run-flags", flags)
        assert (code, why in err) == (2, True), err
