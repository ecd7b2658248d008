"""The examples of docs/reference and the first commands of docs/how-to/security.md work as written."""

import re
import shlex
import sys

import numpy as np
import pytest

import dreamfleet
from dreamfleet.coordinator.optimisers.api import Search
from tests.support import tasks
from tests.support.processes import ROOT, free_port

PYTHON = (ROOT / "docs" / "reference" / "python.md").read_text()
OPTIMISER = re.search(r"```python\n(.*?)```", (ROOT / "docs/reference/optimisers.md").read_text(), re.DOTALL)[1]
HOST = "127.0.0.2"  # in no certificate by default


@pytest.mark.slow
def test_the_snippets_of_the_python_page_run_in_order(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pandas")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    names = {"__name__": "__main__"}
    for number, snippet in enumerate(re.findall(r"```python\n(.*?)```", PYTHON, re.DOTALL)):
        exec(compile(snippet, f"snippet {number}", "exec"), names)
    said = capsys.readouterr().out
    for shown in ("<Run early of gym:CartPole-v1: ", "\n12 generations\n", "<Controller of gym:CartPole-v1: 10 "):
        assert shown in said
    assert (tmp_path / "pole.png").stat().st_size > 1000


def test_the_python_page_names_what_is_public():
    assert sorted(re.findall(r"`(\w+)`", PYTHON.partition("## Names")[2])) == sorted(dreamfleet.__all__)


def test_the_example_of_an_optimiser_learns_and_resumes_with_the_same_bits():
    names = {}
    exec(OPTIMISER, names)
    first, second = (names["Half"](Search(mean=np.zeros(3), population=8, sigma0=0.5, seed=1)) for _ in range(2))
    for _ in range(40):
        first.tell(-np.square(first.ask() - 1).sum(axis=1))
    second.restore(first.state())
    assert np.abs(first.mean - 1).max() < 0.3
    assert np.array_equal(first.ask(), second.ask())


@pytest.mark.slow
def test_the_example_of_an_optimiser_leads_a_run(processes):
    (processes.folder / "half.py").write_text(OPTIMISER)
    flags = ("--task", tasks.TOY, "--optimiser", "half:Half", "--generations", 2, "--evaluate-every", 0)
    (processes.folder / "tests").symlink_to(ROOT / "tests")  # the folder that modules are imported from
    coordinator = processes.coordinator(*flags, root=processes.folder)
    processes.worker("--task", tasks.TOY, "--exit-when-done")
    assert coordinator.finish()[0] == 0


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="other systems have one loopback address")
def test_five_commands_make_a_secured_fleet(processes, tmp_path, monkeypatch):
    port = free_port()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DREAMFLEET_LISTEN", f"tls/{HOST}:{port}")  # others may use 7447
    block = (ROOT / "docs" / "how-to" / "security.md").read_text().split("## In five commands")[1].split("```")[1]
    here = block.replace("coordinator.example", HOST).replace("7447", str(port))
    install, *commands = (shlex.split(line, comments=True) for line in here.splitlines()[1:])
    assert install[:2] == ["pip", "install"]
    *issued, coordinator, worker = [command[1:] for command in commands]
    assert [command[0] for command in issued] == ["access", "access", "access"]
    for each in issued:
        code, _, err = processes.call(*each)
        assert code == 0, err
    assert (coordinator[0], worker[0]) == ("coordinator", "worker")
    processes.start(*coordinator).wait_until_serving()
    processes.start(*worker, "--slots", 1).wait_for("1 slot")
