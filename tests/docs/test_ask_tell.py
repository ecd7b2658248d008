"""The examples of docs/how-to/ask-tell.md, each in its own language, against a real fleet."""

import re
import shlex
import subprocess
import sys

import pytest

from dreamfleet.common.artifacts.controller import Controller
from tests.support.processes import DEADLINE, ROOT, environment

PAGE = ROOT / "docs" / "how-to" / "ask-tell.md"
ADDRESS, HTTP = "tcp/127.0.0.1:7447", "http://127.0.0.1:8700"


def block(language, place=0):
    return re.findall(rf"^```{language}\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)[place]


@pytest.fixture
def fleet(processes):
    """The page's own first commands, at a free port."""
    begin, work = (shlex.split(line, comments=True)[1:] for line in block("sh").splitlines())
    processes.start(*begin, "--listen", processes.endpoint, "--runs-dir", processes.runs).wait_until_serving()
    processes.start(*work, "--connect", processes.endpoint, "--slots", 1)
    return processes


@pytest.fixture
def bridge(fleet):
    *_, serve = block("sh", 1).splitlines()
    words = ["--port", "0", *shlex.split(serve.replace(ADDRESS, fleet.endpoint), comments=True)[2:]]
    return fleet.start("serve", *words).wait_until_serving()


def run(*command, where, cache):
    done = subprocess.run(command, cwd=where, env=environment(cache), capture_output=True, text=True, check=False,
                          timeout=DEADLINE)  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_pycmas_own_loop(fleet, tmp_path):
    code = block("python").replace(ADDRESS, fleet.endpoint)
    out = run(sys.executable, "-c", code, where=tmp_path, cache=fleet.cache).splitlines()
    assert [line.split()[0] for line in out] == [*"01234"]
    assert float(out[-1].split()[1]) >= 8.0  # steps: no pole falls sooner
    again = run(sys.executable, "-c", code, where=tmp_path, cache=fleet.cache).splitlines()
    assert again == out  # the same ids and the same seeds: found, not scored again


@pytest.mark.slow
@pytest.mark.needs_programs("curl")
def test_curl(fleet, bridge, tmp_path):
    out = run("sh", "-ec", block("sh", 2).replace(HTTP, bridge), where=tmp_path, cache=fleet.cache)
    assert '"text":' not in out  # an error's answer
    assert out.count("event: candidate") == 2
    assert out.rindex('"batches":') > out.rindex('"fitness":') > 0


@pytest.mark.slow
def test_the_best_vector_is_kept_evaluated_and_recorded(fleet, tmp_path, monkeypatch):
    echo, *commands = block("sh", 3).splitlines()
    subprocess.run(["sh", "-c", echo], cwd=tmp_path, check=True)
    monkeypatch.setenv("DREAMFLEET_RUNS_DIR", str(fleet.runs))
    done = [run(sys.executable, "-P", "-m", *shlex.split(line), where=tmp_path, cache=fleet.cache) for line in commands]
    assert Controller.load(tmp_path / "best.npz").parameters.tolist() == [0, 0, -1, -1, 0, 0, 1, 1, 0, 0]
    assert float(re.search(r"-?\d+\.\d", done[1])[0]) > 100  # steps; a random one falls after twenty
    assert (tmp_path / "best.mp4").stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.needs_programs("node")
def test_javascript(fleet, bridge, tmp_path):
    (tmp_path / "search.mjs").write_text(block("javascript").replace(HTTP, bridge))
    out = run("node", "search.mjs", where=tmp_path, cache=fleet.cache).splitlines()
    assert [line.lstrip(".").split()[0] for line in out] == [*"01234"]


@pytest.mark.slow
@pytest.mark.needs_programs("g++", "curl-config")
def test_cpp(fleet, bridge, tmp_path):
    (tmp_path / "search.cpp").write_text(block("cpp").replace(HTTP, bridge))
    run("g++", "-std=c++17", "search.cpp", "-lcurl", where=tmp_path, cache=fleet.cache)
    out = run("./a.out", where=tmp_path, cache=fleet.cache)
    scores = re.search(r'"fitness":\[([^\]]*)\]', out)[1].split(",")
    assert len(scores) == 8
    assert all(float(each) >= 8.0 for each in scores)
