import sys
from importlib.metadata import packages_distributions

import pytest

from dreamfleet.common.host.packages import find_distributions, hidden


@pytest.mark.parametrize("module", ["numpy", "numpy.linalg", "zenoh", "Box2D.b2", "yaml", "six", "absent", "obj"])
def test_the_distributions_of_a_module_are_those_that_the_library_finds(module):
    assert find_distributions(module) == tuple(packages_distributions().get(module.partition(".")[0], ()))


def test_a_hidden_module_cannot_be_imported_inside_and_can_be_afterwards(monkeypatch):
    monkeypatch.delitem(sys.modules, "this", raising=False)
    with hidden("this", "json"):
        import json  # noqa: F401 - loaded before, so it stays

        with pytest.raises(ModuleNotFoundError):
            import this  # noqa: F401
    assert "this" not in sys.modules
