"""The panel in a terminal of any width. Tests terminal_charts.py and worker_table.py."""

import io
import re
from dataclasses import fields, is_dataclass, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console

from dreamfleet.common.client.equal_fitness import ENOUGH
from dreamfleet.common.client.status import FailureStatus, Population, StageStatus
from dreamfleet.common.runs.records import StageSettings
from dreamfleet.coordinator.addons.status.status_panel import Block, RunPanel, allocate_lines, panel_lines
from dreamfleet.coordinator.addons.status.terminal_charts import bar_chart, candidate_grid
from dreamfleet.coordinator.addons.status.worker_table import WorkerTable, find_slowest
from tests.support.large_status import FLEET, LARGE
from tests.support.samples import STATUS

LONG = "a-host-with-quite-a-long-name.example.org/0a1b2c3d"
WORKER = replace(
    STATUS.worker_list[0], worker=LONG, steps_per_second=12345.6, finished=123456, load=12.25, drawn_by="gymnasium"
)
FAILURE = FailureStatus("4/0", "evaluate", (20003,), {LONG: "ValueError: no road"}, {LONG: 1})


def drawn(width, *flags, status=STATUS, **changes):
    console = Console(file=io.StringIO(), width=width)
    console.print(RunPanel(replace(status, **changes), *flags))
    return console.file.getvalue()


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_workers_name_is_never_truncated(width):
    text = drawn(width, worker_list=(WORKER,))
    assert LONG in text
    assert "…" not in text


def test_the_least_important_columns_are_left_out_first():
    narrow, wide = drawn(80, worker_list=(WORKER,)), drawn(160, worker_list=(WORKER,))
    assert all(column in wide for column in ("slots", "assigned", "finished", "load", "picture", "resent"))
    assert "state" in narrow
    assert "picture" not in narrow


@pytest.mark.parametrize(("width", "height"), [(80, 24), (60, 10), (200, 60), (20, 5)])
def test_a_fitted_panel_fits_the_terminal(width, height):
    console = Console(file=io.StringIO(), width=width, height=height)
    console.print(RunPanel(LARGE, fitted=True))
    lines = console.file.getvalue().splitlines()
    assert len(lines) <= height - 1
    assert max(map(cell_len, lines)) <= width


def test_80_columns_and_24_lines_show_every_part():
    lines = [line.plain for line in panel_lines(LARGE, 76, 21)]
    assert len(lines) == 21
    assert all(part in "\n".join(lines) for part in ("episodes", "reported", "worker"))
    rows = [line for line in lines if line.startswith("a-host")]
    assert len(rows) >= 3
    assert {line.split()[0] for line in rows} <= {each.worker for each in FLEET}
    assert re.search(rf"\b{40 - len(rows)}\b", lines[-1])


def test_lost_and_slow_workers_are_shown_first():
    odd = {17: {"state": "silent"}, 31: {"job_seconds": 4.6}}
    fleet = [replace(each, **odd.get(number, {})) for number, each in enumerate(FLEET)]
    lines = [line.plain for line in WorkerTable(fleet, 41).lines(76, 5)]
    assert [line.split("  ")[0] for line in lines[1:4]] == [fleet[number].worker for number in (0, 17, 31)]
    assert "4.6 s" in lines[3]
    assert re.search(r"\b38\b", lines[4])
    assert find_slowest(FLEET) is None


def test_a_name_longer_than_the_terminal_wraps():
    lines = [line.plain for line in WorkerTable([WORKER], 1).lines(30, 10)]
    assert "".join(lines[1:]) == LONG
    assert WorkerTable([WORKER], 1).height(30) == len(lines)


@pytest.mark.parametrize(
    ("lines", "given_lines"),
    [(None, [9, 1, 5]), (0, [0, 0, 0]), (2, [0, 1, 0]), (5, [4, 1, 0]), (7, [3, 1, 3]), (99, [9, 1, 5])],
)
def test_lines_go_to_the_blocks_of_the_highest_priority(lines, given_lines):
    blocks = [Block(1, 2, 4, 9, list), Block(0, 1, 1, 1, list), Block(2, 3, 5, 5, list)]
    assert allocate_lines(blocks, lines) == given_lines


SIZES = st.tuples(st.integers(0, 9), st.integers(1, 5), st.integers(0, 5), st.integers(0, 5))


@given(st.lists(SIZES), st.integers(0, 40))
def test_no_more_lines_are_given_than_available(parts, lines):
    blocks = [Block(priority, least, least + more, least + more + most, list) for priority, least, more, most in parts]
    given_lines = allocate_lines(blocks, lines)
    assert sum(given_lines) <= lines
    for block, found in zip(blocks, given_lines, strict=True):
        assert found == 0 or block.min_lines <= found <= block.max_lines


def test_candidates_are_cells_and_the_best_is_highlighted():
    population = Population(7, 0, 5, (4, 2, 1, 0, 4), (4, 4, 4, 4, 4), (1.0, 2.0, 3.0, None, 4.0))
    (line,) = candidate_grid(population, 80, 1)
    assert line.plain == "█▄▂·█"
    assert line.spans[-1].style == "bold yellow"
    many = Population(7, 0, 300, (4,) * 150 + (0,) * 150, (4,) * 300, (None,) * 300)
    assert [len(each) for each in candidate_grid(many, 76, 2)] == [76, 74]


def test_a_failed_candidate_is_no_waiting_one():
    some = Population(7, 0, 4, (2, 0, 0, 1), (2, 0, 2, 2), (1.0, None, None, 2.0))
    (line,) = candidate_grid(some, 80, 1)
    assert line.plain == "█x·▄"
    assert line.spans[1].style == "red"
    assert re.search(r"(?s)\b7 .*3/8 .*1\.0.*2\.0", drawn(100, population=some))
    none = Population(7, 0, 3, (0, 0, 0), (0, 0, 0), (None, None, None))
    assert re.search(r"\b7 ", drawn(100, population=none))


def test_a_failure_is_named_by_what_it_scores_and_says_when_it_is_tried_again():
    def shown(**changes):
        return " ".join(drawn(200, why="", failures=(replace(FAILURE, **changes),)).split())

    assert re.search(rf"\b4\b.* 20003.* {LONG}.*ValueError: no road", shown())
    assert re.search("4/0.* 20003", shown(kind="score"))
    assert re.search("no road.* 1 min ", shown(retry_in=64.0))
    assert replace(FAILURE, errors={}).subject in shown(errors={})


def test_a_refused_worker_is_told_beside_those_that_are_here():
    refused = replace(STATUS, refused={"vm": "no gymnasium"})
    for workers in (STATUS.worker_list, ()):
        assert re.search("vm .*no gymnasium", drawn(80, status=refused, worker_list=workers))
    assert "no gymnasium" not in drawn(80, status=refused, state="ended", why="stopped")


def test_a_curve_has_the_given_height():
    assert bar_chart([0.0, 7.0], 1) == ["▁█"]
    assert bar_chart([0.0, 15.0], 2) == [" █", "▁█"]
    assert bar_chart([3.0, 3.0], 2) == ["  ", "▁▁"]


@pytest.mark.parametrize("width", [30, 80, 200])
def test_why_a_worker_left_stands_beneath_it(width):
    left = replace(WORKER, state="left", reason="no environment\x1b[2J " + "word " * 30)
    panel = drawn(width, worker_list=(left,))
    assert panel.count("word") == 30
    assert "\x1b" not in panel


MEANS = (-1.7e308, 1.7e308), (0.0, 5e-324), (3.0, 3.0)


@pytest.mark.parametrize(
    ("changes", "shown"),
    [
        ({"evaluation": replace(STATUS.best, failed=1)}, r"\b16 .* 1 .*4"),
        ({"state": "ended", "why": "7 generations"}, r"7 generations.*\b6 .*8/8 .*-12\.5.*140\.0"),  # of the last one
        ({"workers": replace(STATUS.workers, known=31)}, r"\b30\b"),
        ({"worker_list": ()}, "dreamfleet worker --run night --connect tcp/lab:7448"),
        *(({"recent": tuple(replace(STATUS.last, mean=mean) for mean in means)}, "▁") for means in MEANS),
    ],
)
def test_the_panel_shows(changes, shown):
    assert re.search(f"(?s){shown}", drawn(100, "--connect tcp/lab:7448", **changes))


def test_a_functions_run_counts_calls():
    task = replace(STATUS.settings.task, task="function:mine:cost", horizon=1)
    panel = drawn(120, settings=replace(STATUS.settings, task=task))
    assert "calls/s" in panel
    assert "steps" not in panel.partition("throughput")[2].partition("\n")[0]


HOSTILE = "[/bold][red]\x1b[2J\x1b]0;owned\x07\u202e\ud800[link=x]\n2026"


def hostile(value):
    """The document with every text replaced by one with markup and control characters."""
    if isinstance(value, str):
        return HOSTILE
    if isinstance(value, dict):
        return {hostile(key): hostile(each) for key, each in value.items()}
    if isinstance(value, (tuple, list)):
        return tuple(map(hostile, value))
    if is_dataclass(value):
        return replace(value, **{each.name: hostile(getattr(value, each.name)) for each in fields(value)})
    return value


@pytest.mark.parametrize("workers", [STATUS.worker_list, ()])
@pytest.mark.parametrize("why", ["", HOSTILE])
def test_untrusted_text_is_no_markup_and_cannot_control_the_terminal(workers, why):
    text = drawn(100, status=hostile(replace(STATUS, worker_list=workers)), why=why)
    assert all(each == "\n" or each.isprintable() for each in text)
    assert "[red]" in text


@pytest.mark.parametrize("columns", [60, 80])
def test_the_curve_covers_the_whole_run(columns):
    history = tuple(replace(STATUS.last, number=number, mean=float(number)) for number in range(4000))
    rows = drawn(columns, recent=history).splitlines()
    (caption,) = (row for row, text in enumerate(rows) if re.search(r"\b0 .*\b3999", text))
    lowest = rows[caption + 7].strip("│ ").split()[-1]  # the line at the bottom: risen to its height in the first bars
    assert lowest.startswith("▁")
    assert lowest.endswith("█")
    assert columns - 15 < len(lowest) < columns


def test_a_driven_stage_is_described_and_its_curve_dims_earlier_ones():
    history = tuple(replace(STATUS.last, number=number) for number in range(7))
    generation = replace(STATUS.generation, temperature=1.5, stage=StageStatus(2, 5))

    def shown(driven):
        stages = StageSettings(generations=5), StageSettings(horizon=1000, driven=driven)
        settings = replace(STATUS.settings, task=replace(STATUS.settings.task, task="dream"), stages=stages)
        return drawn(100, settings=settings, recent=history, generation=generation)

    text = shown(1.0)
    assert re.search("dream, .*1,000", text)
    assert re.search(r"(?s)\b0 .*6.* 2 .*5", text)
    assert re.search(r"(?s)dream, .*1,000.* 50%.* 1\.5", shown(0.5))


def test_generations_of_one_fitness_have_a_line():
    few, many = (replace(STATUS, equal=count, failures=()) for count in (ENOUGH - 1, ENOUGH))
    assert [line.plain for line in panel_lines(few, 300)].count(few.equal_fitness) == 0
    assert [line.plain for line in panel_lines(many, 300)].count(many.equal_fitness) == 1
