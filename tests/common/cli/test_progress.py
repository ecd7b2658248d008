"""A bar's line in a terminal of any width."""

import io
import logging

import pytest
from rich.console import Console

from dreamfleet.common.cli.progress import Bar, make_progress, progress_bar

NOTE = "likelihood -12.345  reward 0.0123"


@pytest.mark.parametrize(
    ("width", "kept", "left_out"),
    [(160, ("━━━━━━━━", "updates", "left"), ()), (80, ("━━━", "left"), ("updates",)), (66, (), ("━", "left"))],
)
def test_what_matters_least_is_left_out_and_nothing_is_cut(width, kept, left_out):
    console = Console(file=io.StringIO(), width=width)
    with make_progress("updates", console) as progress:
        Bar(progress, "train mdnrnn", 4000).update(1200, NOTE)
    line = console.file.getvalue().strip()
    for part in ("train mdnrnn", "1200/4000", NOTE, *kept):
        assert part in line
    assert "…" not in line
    assert not any(part in line for part in left_out)


def test_where_no_bar_moves_a_line_is_said_now_and_then(monkeypatch):
    console = Console(file=io.StringIO(), width=120)
    with make_progress("updates", console) as progress:
        bar = Bar(progress, "VAE", 1800)
        bar.update(1)
        assert not console.file.getvalue()
        monkeypatch.setattr("dreamfleet.common.cli.progress.LOG_INTERVAL", 0.0)
        bar.update(138)
        assert "138/1800" in console.file.getvalue()


@pytest.mark.parametrize(("level", "drawn"), [("INFO", True), ("WARNING", False)])
def test_a_verb_that_is_to_be_quiet_draws_none(capsys, monkeypatch, level, drawn):
    log = logging.getLogger("dreamfleet")
    monkeypatch.setattr(log, "level", log.level)  # and so it is put back
    log.setLevel(level)
    with progress_bar("evaluate", 4, "episodes") as bar:
        bar.update(4)
    assert ("evaluate" in capsys.readouterr().err) == drawn
