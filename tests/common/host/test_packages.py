import re
import subprocess
import sys
from importlib.metadata import packages_distributions, requires

import pytest

from dreamfleet.common.host import packages
from dreamfleet.common.host.packages import find_distributions, hidden, wanted_versions, wrong_version


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


@pytest.mark.parametrize("found", ["0.28.1", "1.3.9", "1.4", "1.4.0", "1.4.7rc1", "1.5.0", None])
def test_a_version_that_another_package_brought_is_found(found, monkeypatch):
    monkeypatch.setattr(packages, "requires", lambda _name: ["numpy<3,>=2.0", 'gymnasium<1.5,>=1.4; extra == "worker"'])
    monkeypatch.setattr(packages, "package_version", lambda _name: found)
    assert wanted_versions("gymnasium") == "gymnasium<1.5,>=1.4"
    for datum in ("gymnasium<1.5,>=1.4", "--no-deps"):
        assert (datum in wrong_version("gymnasium")) == (found in ("0.28.1", "1.3.9", "1.5.0"))
    assert not wrong_version("no-such-package")


def test_doctor_looks_for_all_that_every_role_requires():
    required = {re.match(r"[\w.-]+", each)[0] for each in requires("dreamfleet") if "extra ==" not in each}
    assert {name for name, (_, extra) in packages.PACKAGES.items() if not extra} == required


@pytest.mark.parametrize(
    "script",
    [
        "import dreamfleet.worker.worlds.car_racing.car",
        "from dreamfleet.worker.worlds.gym.environments import make_environment as make; make('LunarLander-v3', {})",
        "from dreamfleet.common.host.trusted_modules import import_trusted; import_trusted('Box2D', 'a test')",
    ],
    ids=["CarRacing", "gymnasium", "a module of the user"],
)
def test_box2d_is_imported_where_warnings_are_errors(script, monkeypatch):
    monkeypatch.setenv("DREAMFLEET_TRUST", "Box2D")
    command = [sys.executable, "-W", "error", "-c", script]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
