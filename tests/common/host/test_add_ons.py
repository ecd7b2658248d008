from importlib.metadata import EntryPoint, entry_points

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host import add_ons
from dreamfleet.common.host.add_ons import add_on, find_add_on


@pytest.fixture
def registered(monkeypatch):
    def register(value):
        monkeypatch.setattr(add_ons, "entry_points", lambda group: [EntryPoint("card", value, group)])

    return register


@pytest.mark.add_on
def test_each_that_is_registered_loads_or_lacks_a_package_of_others():
    points, lacking = entry_points(group="dreamfleet.addons"), []
    assert len(points) >= 6
    for point in points:
        try:
            assert callable(add_on(point.name))
        except ModuleNotFoundError as error:
            lacking.append(str(error.name))
    assert not [name for name in lacking if name.startswith("dreamfleet")]


@pytest.mark.parametrize("value", ["dreamfleet.nowhere.card:Card", "dreamfleet.worker.addons.gone:Card"])
def test_one_whose_folder_is_gone_is_absent(value, registered):
    registered(value)
    assert find_add_on("card") is None
    with pytest.raises(UsageError):
        add_on("card")


def test_a_package_that_one_needs_is_named(registered, tmp_path, monkeypatch):
    (tmp_path / "needy.py").write_text("import nowhere_at_all\n")
    monkeypatch.syspath_prepend(tmp_path)
    registered("needy:Card")
    with pytest.raises(ModuleNotFoundError) as raised:
        find_add_on("card")
    assert raised.value.name == "nowhere_at_all"
