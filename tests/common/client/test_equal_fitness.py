from dataclasses import replace

import pytest

from dreamfleet.common.client.equal_fitness import ENOUGH, EqualFitness, describe_equal_fitness
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
    found = EqualFitness(rows)
    assert found.count == count
    assert not found.has_risen, "no fitness lies above the worst of the run"
    assert EqualFitness([replace(EQUAL, worst=0.0), *rows, EQUAL]).has_risen


@pytest.mark.parametrize(("others", "warned"), [(1, [ENOUGH]), (ENOUGH - 1, [ENOUGH]), (ENOUGH, [ENOUGH, 3 * ENOUGH])])
def test_a_spell_is_warned_of_again_only_after_as_many_other_generations(others, warned):
    rows = [*[EQUAL] * ENOUGH, *[OTHER] * others, *[EQUAL] * 2 * ENOUGH]
    found = EqualFitness()
    due = []
    for number, row in enumerate(rows, 1):
        found.add(row)
        due += [number] if found.is_due else []
    assert due == warned
    found = EqualFitness([EQUAL] * ENOUGH)  # as of a run that is continued
    found.add(EQUAL)
    assert not found.is_due


def test_enough_of_them_are_warned_of():
    for name, flag in (("gym:CartPole-v1", "--sigma0"), ("function:mine:cost", "scale=")):
        task = replace(STATUS.settings.task, task=name)
        assert describe_equal_fitness(ENOUGH - 1, task, has_risen=False) == ""
        assert flag in describe_equal_fitness(ENOUGH, task, has_risen=False)
        assert flag not in describe_equal_fitness(ENOUGH, task, has_risen=True)
