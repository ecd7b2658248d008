"""The panel in a terminal of any width."""

import dataclasses
import io

import pytest
from rich.console import Console

from dreamfleet.common.table import run_panel
from tests.support.samples import STATUS

LONG = "a-host-with-quite-a-long-name.example.org/0a1b2c3d"
WORKER = dataclasses.replace(
    STATUS.worker_list[0], worker=LONG, steps_per_second=12345.6, finished=123456, load=12.25, drawn_by="gymnasium"
)


def drawn(status, width):
    console = Console(file=io.StringIO(), width=width)
    console.print(run_panel(status))
    return console.file.getvalue()


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_workers_name_is_whole_in_a_terminal_of_any_width(width):
    text = drawn(dataclasses.replace(STATUS, worker_list=(WORKER,)), width)
    assert LONG in text
    assert "…" not in text


def test_what_matters_least_is_left_out_first():
    status = dataclasses.replace(STATUS, worker_list=(WORKER,))
    narrow, wide = drawn(status, 80), drawn(status, 140)
    assert all(column in wide for column in ("slots", "leases", "finished", "load", "picture"))
    assert "state" in narrow
    assert "picture" not in narrow


def test_workers_beyond_the_head_are_counted():
    known = dataclasses.replace(STATUS.workers, known=31)
    assert "and 30 more" in drawn(dataclasses.replace(STATUS, workers=known), 80)


def test_a_run_without_workers_says_how_to_start_one():
    assert "dreamfleet worker --connect" in drawn(dataclasses.replace(STATUS, worker_list=()), 80)


HOSTILE = "[/bold][red]\x1b[2J\x1b]0;owned\x07\u202e\ud800[link=x]\n2026"


def hostile(value):
    """The same document with every text replaced by one that a terminal or a table would obey."""
    if isinstance(value, str):
        return HOSTILE
    if isinstance(value, dict):
        return {hostile(key): hostile(each) for key, each in value.items()}
    if isinstance(value, (tuple, list)):
        return tuple(map(hostile, value))
    if dataclasses.is_dataclass(value):
        told = {each.name: hostile(getattr(value, each.name)) for each in dataclasses.fields(value)}
        return dataclasses.replace(value, **told)
    return value


def obeyed(text):
    return [each for each in text if each != "\n" and not each.isprintable()]


@pytest.mark.parametrize("workers", [STATUS.worker_list, ()])
@pytest.mark.parametrize("why", ["", HOSTILE])
def test_no_text_of_others_is_markup_or_an_order_to_a_terminal(workers, why):
    status = dataclasses.replace(hostile(dataclasses.replace(STATUS, worker_list=workers)), why=why)
    text = drawn(status, 100)
    assert not obeyed(text)
    assert "[red]" in text


@pytest.mark.parametrize("means", [(-1.7e308, 1.7e308), (0.0, 5e-324), (3.0, 3.0)])
def test_a_sparkline_of_any_numbers(means):
    recent = tuple(dataclasses.replace(STATUS.recent[0], mean=mean) for mean in means)
    assert "mean fitness by generation" in drawn(dataclasses.replace(STATUS, recent=recent), 100)


def test_a_failure_that_names_no_worker_is_shown():
    failure = dataclasses.replace(STATUS.failures[0], errors={})
    assert "no reason was given" in drawn(dataclasses.replace(STATUS, why="", failures=(failure,)), 100)
