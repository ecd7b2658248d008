"""Native modules that end the process where warnings are errors."""

import subprocess
import sys

import pytest


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
