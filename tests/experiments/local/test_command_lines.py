"""Flags that users give as one text. Tests common/cli/key_values.py."""

import pytest

from dreamfleet.common.cli.key_values import split_flags
from dreamfleet.common.errors import UsageError


@pytest.mark.parametrize("text", ["--seed 3", "--see=3", "--x --seed"])
def test_flags_that_the_caller_sets_are_refused_even_shortened(text):
    with pytest.raises(UsageError, match="--seed"):
        split_flags("--vae-flags", text, "iterate", ("--data", "--seed"))
    assert split_flags("--vae-flags", text) == tuple(text.split())
