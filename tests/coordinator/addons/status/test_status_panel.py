"""The panel in a terminal of any width. Tests terminal_charts.py and worker_table.py."""

import dataclasses
import io
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console

from dreamfleet.common.client.equal_fitness import ENOUGH
from dreamfleet.common.client.status import FailureStatus, Population, StageStatus
from dreamfleet.coordinator.addons.status.status_panel import Block, RunPanel, allocate_lines, panel_lines
from dreamfleet.coordinator.addons.status.terminal_charts import bar_chart, candidate_grid
from dreamfleet.coordinator.addons.status.worker_table import WorkerTable, find_slowest
from tests.support.large_status import FLEET, LARGE
from tests.support.samples import STATUS

LONG = "a-host-with-quite-a-long-name.example.org/0a1b2c3d"
WORKER = dataclasses.replace(
    STATUS.worker_list[0], worker=LONG, steps_per_second=12345.6, finished=123456, load=12.25, drawn_by="gymnasium"
)


def drawn(status, width, *flags):
    console = Console(file=io.StringIO(), width=width)
    console.print(RunPanel(status, *flags))
    return console.file.getvalue()


@pytest.mark.parametrize("width", [60, 80, 120])
def test_a_workers_name_is_never_truncated(width):
    text = drawn(dataclasses.replace(STATUS, worker_list=(WORKER,)), width)
    assert LONG in text
    assert "…" not in text


def test_the_least_important_lines_are_left_out_first():
    status = dataclasses.replace(STATUS, worker_list=(WORKER,))
    narrow, wide = drawn(status, 80), drawn(status, 160)
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
    text = "\n".join(lines)
    assert len(lines) == 21
    for part in ("episodes", "reported", "worker"):
        assert part in text
    rows = [line for line in lines if line.startswith("a-host")]
    assert len(rows) >= 3
    assert {line.split()[0] for line in rows} <= {each.worker for each in FLEET}
    assert re.search(rf"\b{40 - len(rows)}\b", lines[-1])


def test_lost_and_slow_workers_are_shown_first():
    odd = {17: {"state": "silent"}, 31: {"job_seconds": 4.6}}
    fleet = [dataclasses.replace(each, **odd.get(number, {})) for number, each in enumerate(FLEET)]
    lines = [line.plain for line in WorkerTable(fleet, 41).lines(76, 5)]
    assert [line.split("  ")[0] for line in lines[1:4]] == [fleet[number].worker for number in (0, 17, 31)]
    assert "4.6 s" in lines[3]
    assert re.search(r"\b38\b", lines[4])
    assert find_slowest(FLEET) is None


def test_a_name_longer_than_the_terminal_wraps():
    lines = [line.plain for line in WorkerTable([WORKER], 1).lines(30, 10)]
    assert "".join(lines[1:]) == LONG
    assert WorkerTable([WORKER], 1).height(30) == len(lines)


def test_lines_go_to_the_blocks_of_the_highest_priority():
    blocks = [Block(1, 2, 4, 9, list), Block(0, 1, 1, 1, list), Block(2, 3, 5, 5, list)]
    assert allocate_lines(blocks, None) == [9, 1, 5]
    assert allocate_lines(blocks, 0) == [0, 0, 0]
    assert allocate_lines(blocks, 2) == [0, 1, 0]
    assert allocate_lines(blocks, 5) == [4, 1, 0]
    assert allocate_lines(blocks, 7) == [3, 1, 3]
    assert allocate_lines(blocks, 99) == [9, 1, 5]


SIZES = st.tuples(st.integers(0, 9), st.integers(1, 5), st.integers(0, 5), st.integers(0, 5))


@given(st.lists(SIZES), st.integers(0, 40))
def test_no_more_lines_are_given_than_available(parts, lines):
    blocks = [Block(priority, least, least + more, least + more + most, list) for priority, least, more, most in parts]
    given_lines = allocate_lines(blocks, lines)
    assert sum(given_lines) <= lines
    assert all(
        found == 0 or each.min_lines <= found <= each.max_lines for found, each in zip(given_lines, blocks, strict=True)
    )


def test_candidates_are_cells_and_the_best_is_highlighted():
    population = Population(7, 0, 5, (4, 2, 1, 0, 4), (4, 4, 4, 4, 4), (1.0, 2.0, 3.0, None, 4.0))
    (line,) = candidate_grid(population, 80, 1)
    assert line.plain == "█▄▂·█"
    assert line.spans[-1].style == "bold yellow"
    many = Population(7, 0, 300, (4,) * 150 + (0,) * 150, (4,) * 300, (None,) * 300)
    assert [len(each) for each in candidate_grid(many, 76, 2)] == [76, 74]


def test_a_failed_job_says_when_it_is_tried_again():
    failure = FailureStatus("7/1", "score", (1,), {LONG: "no memory"}, {LONG: 3}, retry_in=64.0)
    for failed in (failure, dataclasses.replace(failure, retry_in=None)):
        text = " ".join(drawn(dataclasses.replace(STATUS, failures=(failed,)), 200).split())
        assert re.search("no memory.* 1 min " if failed.retry_in else "no memory", text)


def test_a_failed_candidate_is_no_waiting_one():
    some = Population(7, 0, 4, (2, 0, 0, 1), (2, 0, 2, 2), (1.0, None, None, 2.0))
    (line,) = candidate_grid(some, 80, 1)
    assert line.plain == "█x·▄"
    assert line.spans[1].style == "red"
    assert re.search(r"(?s)\b7 .*3/8 .*1\.0.*2\.0", drawn(dataclasses.replace(STATUS, population=some), 100))
    none = Population(7, 0, 3, (0, 0, 0), (0, 0, 0), (None, None, None))
    assert re.search(r"\b7 ", drawn(dataclasses.replace(STATUS, population=none), 100))


def test_a_failure_is_named_by_what_it_scores():
    failure = FailureStatus("4/0", "evaluate", (20003,), {"host-a": "ValueError: no road"}, {"host-a": 1})
    text = drawn(dataclasses.replace(STATUS, failures=(failure,)), 120)
    assert re.search(r"(?s)\b4\b.* 20003.* host-a.*ValueError: no road", text)
    assert re.search(
        "4/0.* 20003", drawn(dataclasses.replace(STATUS, failures=(dataclasses.replace(failure, kind="score"),)), 120)
    )


def test_a_refused_worker_is_told_beside_those_that_are_here():
    refused = dataclasses.replace(STATUS, refused={"vm": "no gymnasium"})
    for shown in (refused, dataclasses.replace(refused, worker_list=())):
        assert re.search("vm .*no gymnasium", drawn(shown, 80))
    assert "no gymnasium" not in drawn(dataclasses.replace(refused, state="ended", why="stopped"), 80)


def test_failed_episodes_of_an_evaluation_are_told():
    evaluated = dataclasses.replace(STATUS.best, failed=1)
    assert re.search(r"(?s)\b16 .* 1 .*4", drawn(dataclasses.replace(STATUS, evaluation=evaluated), 100))


def test_a_curve_has_the_given_height():
    assert bar_chart([0.0, 7.0], 1) == ["▁█"]
    assert bar_chart([0.0, 15.0], 2) == [" █", "▁█"]
    assert bar_chart([3.0, 3.0], 2) == ["  ", "▁▁"]


def test_an_ended_run_shows_its_last_generations_candidates():
    text = drawn(dataclasses.replace(STATUS, state="ended", why="7 generations"), 100)
    assert "7 generations" in text
    assert re.search(r"(?s)\b6 .*8/8 .*-12\.5.*140\.0", text)


@pytest.mark.parametrize("width", [30, 80, 200])
def test_why_a_worker_left_stands_beneath_it(width):
    left = dataclasses.replace(STATUS.worker_list[0], state="left", reason="no environment\x1b[2J " + "word " * 30)
    panel = drawn(dataclasses.replace(STATUS, worker_list=(left,)), width)
    assert panel.count("word") == 30
    assert "\x1b" not in panel


def test_workers_beyond_the_first_are_counted():
    known = dataclasses.replace(STATUS.workers, known=31)
    assert re.search(r"\b30\b", drawn(dataclasses.replace(STATUS, workers=known), 80))


def test_a_run_without_workers_shows_how_to_start_one():
    gone = dataclasses.replace(STATUS, worker_list=())
    panel = drawn(gone, 80, "--connect tcp/lab:7448")
    assert "dreamfleet worker --run night --connect tcp/lab:7448" in panel


def test_a_functions_run_counts_calls():
    task = dataclasses.replace(STATUS.settings.task, task="function:mine:cost", horizon=1)
    panel = drawn(dataclasses.replace(STATUS, settings=dataclasses.replace(STATUS.settings, task=task)), 120)
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
    if dataclasses.is_dataclass(value):
        values = {each.name: hostile(getattr(value, each.name)) for each in dataclasses.fields(value)}
        return dataclasses.replace(value, **values)
    return value


def obeyed(text):
    return [each for each in text if each != "\n" and not each.isprintable()]


@pytest.mark.parametrize("workers", [STATUS.worker_list, ()])
@pytest.mark.parametrize("why", ["", HOSTILE])
def test_untrusted_text_is_no_markup_and_cannot_control_the_terminal(workers, why):
    status = dataclasses.replace(hostile(dataclasses.replace(STATUS, worker_list=workers)), why=why)
    text = drawn(status, 100)
    assert not obeyed(text)
    assert "[red]" in text


@pytest.mark.parametrize("means", [(-1.7e308, 1.7e308), (0.0, 5e-324), (3.0, 3.0)])
def test_a_sparkline_of_any_numbers(means):
    recent = tuple(dataclasses.replace(STATUS.recent[0], mean=mean) for mean in means)
    assert "▁" in drawn(dataclasses.replace(STATUS, recent=recent), 100)


def test_a_failure_without_worker_is_shown():
    failure = dataclasses.replace(STATUS.failures[0], errors={})
    assert failure.subject in drawn(dataclasses.replace(STATUS, why="", failures=(failure,)), 100)


@pytest.mark.parametrize("columns", [60, 80])
def test_the_curve_covers_the_whole_run(columns):
    history = [dataclasses.replace(STATUS.recent[0], number=number, mean=float(number)) for number in range(4000)]
    rows = drawn(dataclasses.replace(STATUS, recent=tuple(history)), columns).splitlines()
    (caption,) = (row for row, text in enumerate(rows) if re.search(r"\b0 .*\b3999", text))
    lowest = rows[caption + 7].strip("│ ").split()[-1]  # the line at the bottom: risen to its height in the first bars
    assert lowest.startswith("▁")
    assert lowest.endswith("█")
    assert columns - 15 < len(lowest) < columns


def test_a_driven_stage_is_described_and_its_curve_dims_earlier_ones():
    task = dataclasses.replace(STATUS.settings.task, task="dream")
    history = tuple(dataclasses.replace(STATUS.recent[0], number=number) for number in range(7))
    generation = dataclasses.replace(
        STATUS.generation, temperature=1.5, stage=StageStatus(2, 2, 5, 1000, 100, 24, 4, racing=False, driven=1.0)
    )
    status = dataclasses.replace(
        STATUS, settings=dataclasses.replace(STATUS.settings, task=task), recent=history, generation=generation
    )
    text = drawn(status, 100)
    assert re.search("dream, .*1,000", text)
    assert re.search(r"(?s)\b0 .*6.* 2 .*5", text)
    mixed = dataclasses.replace(generation.stage, driven=0.5)
    text = drawn(dataclasses.replace(status, generation=dataclasses.replace(generation, stage=mixed)), 100)
    assert re.search(r"(?s)dream, .*1,000.* 50%.* 1\.5", text)


def test_generations_of_one_fitness_have_a_line():
    few, many = (dataclasses.replace(STATUS, equal=count, failures=()) for count in (ENOUGH - 1, ENOUGH))
    assert [line.plain for line in panel_lines(few, 300)].count(few.equal_fitness) == 0
    assert [line.plain for line in panel_lines(many, 300)].count(many.equal_fitness) == 1
