"""The example of docs/reference/optimisers.md keeps the contract, in a real run too."""

import re

import numpy as np
import pytest

from dreamfleet.coordinator.optimisers.api import Search
from tests.support import tasks
from tests.support.processes import ROOT

CODE = re.search(r"```python\n(.*?)```", (ROOT / "docs/reference/optimisers.md").read_text(), re.DOTALL)[1]


def optimiser():
    names = {}
    exec(CODE, names)
    return names["Half"](Search(mean=np.zeros(3), population=8, sigma0=0.5, seed=1))


def test_the_example_of_an_optimiser_learns_and_resumes_with_the_same_bits():
    first, second = optimiser(), optimiser()
    for _ in range(40):
        first.tell(-np.square(first.ask() - 1).sum(axis=1))
    second.restore(first.state())
    assert np.abs(first.mean - 1).max() < 0.3
    assert np.array_equal(first.ask(), second.ask())


@pytest.mark.slow
def test_the_example_of_an_optimiser_leads_a_run(processes):
    (processes.folder / "half.py").write_text(CODE)
    flags = ("--task", tasks.TOY, "--optimiser", "half:Half", "--generations", 2, "--evaluate-every", 0)
    (processes.folder / "tests").symlink_to(ROOT / "tests")  # the folder that modules are imported from
    coordinator = processes.coordinator(*flags, root=processes.folder)
    processes.worker("--task", tasks.TOY, "--exit-when-done")
    assert coordinator.finish()[0] == 0
