import io
import os
from pathlib import Path

import pytest
from rich.console import Console

from dreamfleet.common.cli.progress import LARGEST_TOTAL, Bar, make_progress, progress_bar

NOTE = "likelihood -12.345  reward 0.0123"


@pytest.mark.parametrize(
    ("width", "kept", "left_out"),
    [(160, ("━━━━━━━━", "updates", "left"), ()), (80, ("━━━", "left"), ("updates",)), (66, (), ("━", "left"))],
)
def test_the_least_important_columns_are_left_out_and_nothing_is_truncated(width, kept, left_out):
    console = Console(file=io.StringIO(), width=width)
    with make_progress("updates", console) as progress:
        Bar(progress, "train mdnrnn", 4000).update(1200, NOTE)
    line = console.file.getvalue().strip()
    for part in ("train mdnrnn", "1200/4000", NOTE, *kept):
        assert part in line
    assert "…" not in line
    assert not any(part in line for part in left_out)


def test_without_a_terminal_a_line_is_logged_periodically(monkeypatch):
    console = Console(file=io.StringIO(), width=120)
    with make_progress("updates", console) as progress:
        bar = Bar(progress, "VAE", 1800)
        bar.update(1)
        assert not console.file.getvalue()
        monkeypatch.setattr("dreamfleet.common.cli.progress.LOG_INTERVAL", 0.0)
        bar.update(138)
        assert "138/1800" in console.file.getvalue()


def test_a_total_beyond_every_number_is_drawn():
    console = Console(file=io.StringIO(), width=200)
    progress = make_progress("updates", console)
    bar = Bar(progress, "training", 10**400)
    for done in range(9):
        bar.update(done)
        console.print(progress.get_renderable())
        assert f"{done}/{LARGEST_TOTAL}" in console.file.getvalue()


def test_what_a_simulator_prints_and_where_it_goes_meanwhile_is_undone_and_a_quiet_verb_draws_no_bar(capfd, caplog):
    before = Path.cwd()
    with caplog.at_level("INFO", "dreamfleet"), progress_bar("evaluate", 4, "episodes") as bar:
        bar.update(4)
        print("from Python")  # noqa: T201
        os.write(1, b"from native code\n")
        os.chdir("/")
    print("the answer")  # noqa: T201
    out, err = capfd.readouterr()
    assert out == "the answer\n"
    assert "from Python" in err
    assert "from native code" in err
    assert "evaluate" in err
    with caplog.at_level("WARNING", "dreamfleet"), progress_bar("evaluate", 4, "episodes") as bar:
        bar.update(4)
    assert "evaluate" not in capfd.readouterr().err
    assert Path.cwd() == before
