"""A bar's line in a terminal of any width."""

import io

import pytest
from rich.console import Console

from dreamfleet.common.progress import Bar, fitted

NOTE = "likelihood -12.345  reward 0.0123"


@pytest.mark.parametrize(
    ("width", "kept", "left_out"),
    [(160, ("━━━━━━━━", "updates", "left"), ()), (80, ("━━━", "left"), ("updates",)), (66, (), ("━", "left"))],
)
def test_what_matters_least_is_left_out_and_nothing_is_cut(width, kept, left_out):
    console = Console(file=io.StringIO(), width=width)
    with fitted("updates", console) as progress:
        Bar(progress, "train mdnrnn", 4000).move(1200, NOTE)
    line = console.file.getvalue().strip()
    for part in ("train mdnrnn", "1200/4000", NOTE, *kept):
        assert part in line
    assert "…" not in line
    assert not any(part in line for part in left_out)
