"""Generations in a row whose candidates all have one fitness."""

from dataclasses import replace

import pytest

from dreamfleet.common.monitoring.equal_fitness import ENOUGH, count_equal_fitness, describe_equal_fitness
from dreamfleet.common.runs.records import StoredGeneration
from tests.support.samples import STATUS

EQUAL = StoredGeneration(0, 1.0, 0.0, 1.0, 1.0, 0.1, 10, 1.0)
OTHER = replace(EQUAL, best=2.0)
FAILED = replace(EQUAL, failed=1)


@pytest.mark.parametrize(
    ("rows", "count"),
    [([], 0), ([EQUAL], 1), ([OTHER, EQUAL, EQUAL], 2), ([EQUAL, OTHER], 0), ([EQUAL, FAILED, EQUAL], 1)],
)
def test_the_last_generations_in_a_row_are_counted(rows, count):
    assert count_equal_fitness(rows, STATUS.settings) == count
    external = replace(STATUS.settings, optimiser="external")
    assert count_equal_fitness(rows, external) == (0 if external.is_external else count)


def test_enough_of_them_are_warned_of():
    for name, flag in (("gym:CartPole-v1", "--sigma0"), ("function:mine:cost", "scale=")):
        task = replace(STATUS.settings.task, task=name)
        assert describe_equal_fitness(ENOUGH - 1, task) == ""
        assert flag in describe_equal_fitness(ENOUGH, task)
