"""Command lines of coordinators, and flags that users give as one text. Tests common/cli/key_values.py."""

from pathlib import Path

import pytest

from dreamfleet.common.cli.key_values import split_flags
from dreamfleet.common.errors import UsageError
from dreamfleet.experiments.command_lines import begin_run, options


def test_command_lines_hold_words_only_and_leave_out_what_is_none():
    run = begin_run("r", Path("runs"), ("tcp/a:1",), *options(bundle="tiny", seed=3, init=None, own_drives=4))
    words = "coordinator --bundle tiny --seed 3 --own-drives 4 --run r --runs-dir runs --json --listen tcp/a:1"
    assert " ".join(run) == words


@pytest.mark.parametrize("text", ["--seed 3", "--see=3", "--x --seed"])
def test_flags_that_the_caller_sets_are_refused_even_shortened(text):
    with pytest.raises(UsageError, match="--seed"):
        split_flags("--vae-flags", text, "iterate", ("--data", "--seed"))
    assert split_flags("--vae-flags", text) == tuple(text.split())
