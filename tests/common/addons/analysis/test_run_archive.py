"""Reading an archive from a journal: cells by number and by values. Tests common/client/elite_archive.py."""

import pytest

from dreamfleet.common.addons.analysis.run_archive import RunArchive, tables
from dreamfleet.common.client.elite_archive import Elite
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.measures import parse_axes

AXES = parse_axes(("speed=0:100:10", "braking=0:1:5"))


def elite(cell, fitness):
    measures = tuple(sum(axis.bounds_of(place)) / 2 for axis, place in zip(AXES, cell, strict=True))
    return Elite(cell, 1, 2, fitness, measures)


ARCHIVE = RunArchive(
    AXES, {cell: elite(cell, fitness) for cell, fitness in {(0, 0): 1.0, (5, 2): 3.0, (9, 4): 2.0}.items()}
)


def test_an_elite_is_found_by_its_cell_or_by_values_in_it():
    assert ARCHIVE.find("5,2").fitness == 3
    assert ARCHIVE.find("braking=0.5,speed=55").fitness == 3
    assert ARCHIVE.find("speed=1e9,braking=7").fitness == 2


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("5,3", "5,2"), ("5", "0-9,0-4"), ("5,5", "0-9,0-4"), ("speed=3", "speed=0,braking=0"),
        ("speed=x,braking=1", "--cell"),
    ],
)  # fmt: skip
def test_an_empty_or_impossible_cell_says_what_there_is(text, named):
    with pytest.raises(UsageError, match=named):
        ARCHIVE.find(text)


def test_facts_and_tables():
    assert ARCHIVE.facts["filled"] == 3
    assert ARCHIVE.qd_score == 6
    assert "3 of 50" in ARCHIVE.description
    columns, rows = tables(ARCHIVE)
    assert columns == ["cell.speed", "cell.braking", "speed", "braking", "fitness", "generation", "candidate"]
    assert list(rows[0]) == columns
    grid = ARCHIVE.grid()
    assert grid.shape == (10, 5)
    assert grid[5, 2] == 3


def test_a_picture_shows_the_best_elite_over_further_axes_and_a_single_axis_as_a_row():
    axes = parse_axes(("speed=0:100:2", "braking=0:1:2", "steering=0:1:2"))
    elites = {cell: Elite(cell, 1, 2, fitness, (0, 0, 0)) for cell, fitness in {(1, 0, 0): 3.0, (1, 0, 1): 4.0}.items()}
    many = RunArchive(axes, elites)
    assert (list(many.shown), many.shown[1, 0].cell, many.grid()[1, 0]) == ([(1, 0)], (1, 0, 1), 4.0)
    one = RunArchive(axes[:1], {(1,): Elite((1,), 1, 2, 3.0, (60.0,))})
    assert ([axis.cells for axis in one.shown_axes], one.grid()[1, 0]) == ([2, 1], 3.0)


def test_elites_are_added_one_generation_after_another_as_all_at_once():
    earlier, later = [(0, 0, 1.0, (5, 0)), (0, 1, 2.0, (7, 0.1))], [(1, 0, 2.0, (3, 0)), (1, 1, 9.0, (95, 1))]
    archive = RunArchive(AXES, {})
    for each in [*earlier, *later, (1, 2, 5.0, (1,)), *later]:
        archive.add(*each)
    assert {cell: (each.generation, each.candidate) for cell, each in archive.elites.items()} == {
        (0, 0): (0, 1), (9, 4): (1, 1),
    }  # fmt: skip
    assert all(each in archive.describe_elite(archive.find("9,4")) for each in ("9,4", "95.0", "1.0", "9.0", "1/1"))
