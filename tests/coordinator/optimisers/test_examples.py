"""What the docstrings show runs as it stands."""

import doctest
from importlib import import_module

import numpy as np
import pytest

from dreamfleet.coordinator.optimisers.api import Search


@pytest.mark.parametrize("module", ["optimisers.pycma", "optimisers.cmaes_library", "optimisers.evolution"])
def test_a_class_shows_an_example_that_runs(module):
    found = import_module(f"dreamfleet.coordinator.{module}")
    failed, tried = doctest.testmod(found, extraglobs={"np": np, "Search": Search}, raise_on_error=True)
    assert tried
    assert not failed
