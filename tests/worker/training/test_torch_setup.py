import os
import subprocess
import sys

import pytest

from dreamfleet.worker.training import torch_setup

ASKED = """
import os, sys
from dreamfleet.worker.training.torch_setup import configure_process
configure_process()
assert "torch" not in sys.modules
import torch
torch.manual_seed(0)
layer, pictures = torch.nn.Conv2d(3, 8, 4, 2), torch.rand(64, 3, 64, 64)
for _ in range(3):
    layer(pictures).square().sum().backward()
print(os.environ["OMP_WAIT_POLICY"], layer.weight.grad.double().sum().item().hex())
"""


@pytest.fixture
def allocator_calls(monkeypatch):
    """The calls of the C library's allocator settings."""
    calls = []
    for name in [each for each in os.environ if each.startswith(("MALLOC_", "OMP_WAIT"))]:
        monkeypatch.delenv(name)
    monkeypatch.setattr(torch_setup, "_keep_freed_memory", lambda: calls.append("keep"))
    yield calls
    os.environ.pop("OMP_WAIT_POLICY", None)


def test_threads_that_wait_sleep_and_the_heap_keeps_what_is_freed(allocator_calls):
    torch_setup.configure_process()
    assert (os.environ["OMP_WAIT_POLICY"], allocator_calls) == ("PASSIVE", ["keep"])


def test_what_the_user_set_stays(allocator_calls, monkeypatch):
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    monkeypatch.setenv("MALLOC_ARENA_MAX", "2")
    torch_setup.configure_process()
    assert (os.environ["OMP_WAIT_POLICY"], allocator_calls) == ("ACTIVE", [])


def test_a_system_without_such_a_heap_is_left_alone(monkeypatch):
    asked = []

    class Library:
        def __getattr__(self, name):
            asked.append(name)
            raise AttributeError(name)

    monkeypatch.setattr(torch_setup.ctypes, "CDLL", lambda _name: Library())
    torch_setup._keep_freed_memory()
    assert asked == ["mallopt"]


@pytest.mark.slow
def test_nothing_that_is_learnt_depends_on_it():
    """The gradients are equal in a configured process and in one with other settings in its environment."""
    own = {name: text for name, text in os.environ.items() if not name.startswith(("OMP_", "MALLOC_"))}
    other = own | {"OMP_WAIT_POLICY": "ACTIVE", "MALLOC_ARENA_MAX": "2"}
    first, second = (
        subprocess.run([sys.executable, "-c", ASKED], env=each, capture_output=True, text=True, check=True).stdout
        for each in (own, other)
    )
    assert (first.split()[0], second.split()[0]) == ("PASSIVE", "ACTIVE")
    assert first.split()[1] == second.split()[1]
