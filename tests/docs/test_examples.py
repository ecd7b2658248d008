"""The examples of docs/reference, docs/how-to and own_agent.py work as written, each in its own language.

Tests coordinator/addons/runs/stored_run.py, dreamfleet/experiments/controllers.py, dreamfleet/experiments/minimise.py,
dreamfleet/experiments/started_run.py, worker/dream/environment.py and worker/worlds/car_racing/latent.py.
"""

import re
import shlex
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location

import gymnasium
import numpy as np
import pytest

import dreamfleet
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support import tasks
from tests.support.bundles import write_random_bundle
from tests.support.processes import DEADLINE, ROOT, call_here, environment, free_port

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


def test_the_documented_configuration_file_is_accepted_by_every_kind_of_verb(tmp_path):
    text, path = (ROOT / "docs" / "how-to" / "configure.md").read_text(), tmp_path / "fleet.toml"
    path.write_text(re.search(r"```toml\n(.*?)```", text, re.DOTALL)[1].replace("/data/runs", str(tmp_path / "runs")))
    assert call_here("runs", "list", "--config", path)[0] == 0
    for verb, flag, name in (("coordinator", "--resume", "absent"), ("worker", "--run", "No Good")):
        assert repr(name) in call_here(verb, flag, name, "--config", path)[2]


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
        processes.printed(*each)
    assert (coordinator[0], worker[0]) == ("coordinator", "worker")
    processes.start(*coordinator).wait_until_serving()
    processes.start(*worker, "--slots", 1).wait_for("1 slot")


SCRIPT = ROOT / "docs" / "tutorials" / "own_agent.py"


@pytest.fixture
def small(tmp_path):
    eyes, memory = VAEConfig(latent=4, channels=(4, 4, 8, 8)), MDNRNNConfig(latent=4, hidden=8, mixtures=2)
    return write_random_bundle(tmp_path / "small.zip", vae=eyes, rnn=memory)


@pytest.mark.slow
def test_it_learns_in_the_dream_and_is_judged_on_real_tracks(small, tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    words = (sys.executable, SCRIPT, "--steps", "12000", "--episodes", "1", "--bundle", small.path)
    learning, learnt, random = run(*words, where=tmp_path, cache=tmp_path).splitlines()
    assert learning.startswith("11776 steps, ")
    for name, line in ("learnt", learnt), ("random", random):
        assert re.fullmatch(rf"{name}: -?\d+\.\d on one real track", line)


def test_a_choice_is_held_until_the_dream_ends_and_no_longer(small):
    spec = spec_from_file_location("own_agent", SCRIPT)
    script = module_from_spec(spec)
    spec.loader.exec_module(script)
    dreams, single = (
        gymnasium.make_vec(script.DREAM, 2, "vector_entry_point", bundle=small, features="zh", horizon=6)
        for _ in range(2)
    )
    dreams.reset(seed=1)
    single.reset(seed=1)
    steps = [single.step(script.ACTIONS[[1, 3]]) for _ in range(8)]
    first, second = (script.hold(dreams, np.array([1, 3])) for _ in range(2))
    assert not first.over.any()
    assert second.over.all()
    assert not (second.failed | second.last).any()
    for held, played, after, now in ((first, steps[:4], 3, 3), (second, steps[4:6], 5, 7)):
        assert np.array_equal(held.reward, sum(step[1] for step in played))
        assert np.array_equal(held.after, steps[after][0])
        assert np.array_equal(held.now, steps[now][0])


ASK_TELL = ROOT / "docs" / "how-to" / "ask-tell.md"
ADDRESS, HTTP = "tcp/127.0.0.1:7447", "http://127.0.0.1:8700"


def block(language, place=0):
    return re.findall(rf"^```{language}\n(.*?)^```", ASK_TELL.read_text(), re.MULTILINE | re.DOTALL)[place]


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
