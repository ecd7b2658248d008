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
