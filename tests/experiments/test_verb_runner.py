"""Verbs that other verbs run in processes of their own, and the command lines that spell them.
Tests common/cli/model_commands.py."""

from pathlib import Path

import pytest

from dreamfleet.common.cli import model_commands
from dreamfleet.common.errors import DreamfleetError, StoppedError, UsageError
from dreamfleet.common.host.stop_signals import never_stop
from dreamfleet.experiments.verb_runner import ProcessRunner, find_verb

LIST = ("runs", "list", "--json", "--runs-dir")


def test_a_command_line_begins_with_a_verb_of_one_or_two_words():
    assert find_verb(("train", "vae", "--summary"))[::2] == ("train", ("vae", "--summary"))
    assert find_verb(("evaluate", "--json"))[::2] == ("evaluate", ("--json",))
    with pytest.raises(DreamfleetError, match="no verb 'xyzzy' is installed"):
        find_verb(("xyzzy",))


def test_a_verb_in_its_own_process_answers_and_logs(tmp_path):
    runner, log, lines = ProcessRunner(never_stop), tmp_path / "logs" / "verb.log", []
    assert runner.run_for_json((*LIST, tmp_path), log) == []
    with pytest.raises(UsageError, match="unrecognized arguments: --xyzzy"):
        runner.run(("runs", "list", "--xyzzy"), log, lines.append)
    assert "--xyzzy" in log.read_text()
    assert "--xyzzy" in lines[-1]
    with pytest.raises(StoppedError):
        ProcessRunner(lambda: True).run((*LIST, tmp_path), log)


def test_command_lines_hold_words_only_and_leave_out_what_is_none():
    words = model_commands.collect(Path("data"), "--noise", 0.3, preset="tiny", seed=1, jobs=2)
    assert " ".join(words) == "collect --data data --preset tiny --seed 1 --jobs 2 --noise 0.3 --json"
    assert " ".join(model_commands.train("vae", Path("data"), "--batch", 4, seed=0)) == (
        "train vae --data data --seed 0 --json --batch 4"
    )
    run = model_commands.begin_run("r", Path("runs"), ("tcp/a:1",), world_model="tiny", seed=3, init=None)
    assert " ".join(run) == "coordinator --run r --bundle tiny --seed 3 --runs-dir runs --json --listen tcp/a:1"


@pytest.mark.parametrize("text", ["--seed 3", "--see=3", "--x --seed"])
def test_flags_that_the_caller_sets_are_refused_even_shortened(text):
    with pytest.raises(UsageError, match="--vae-flags: omit --seed, which iterate sets itself"):
        model_commands.split_flags("--vae-flags", text, "iterate", ("--data", "--seed"))
    assert model_commands.split_flags("--vae-flags", text) == tuple(text.split())
