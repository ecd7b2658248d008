"""Files of other people name a module in every place that holds a name: no verb imports it unless the user named it.

Tests common/host/trusted_modules.py, common/protocol/tasks.py and coordinator/optimisers/registry.py.
"""

import json
import os
import shutil
import socket
import sys
from dataclasses import replace
from importlib.metadata import entry_points

import numpy as np
import pygame
import pytest

from dreamfleet.common.addons.evaluation_report import EvaluationReport
from dreamfleet.common.artifacts.bundle import Bundle, write_bundle
from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.cli import command_line
from dreamfleet.common.runs.episode_results import EpisodeResult
from dreamfleet.worker.worldmodel.onnx_graph import GraphBuilder
from dreamfleet.worker.worlds.trained_agent import AgentManifest, TrainedAgent
from tests.support.journals import change_journal
from tests.support.processes import ROOT, call_here

MARK = "foreign_marker"  # the module that nobody named
FIXTURES = ROOT / "tests" / "fixtures"
DRIVES = EpisodeResult(5000, 1.0, 1), EpisodeResult(5001, 2.0, 1)
OWN, GYM = f"{MARK}:World", f"gym:{MARK}:X-v0"
# Verbs that read no file, journal, message or report of somebody else in which a task or an optimiser has a name.
NAMELESS = {
    "access.init", "access.issue", "access.list", "access.revoke", "baseline.export",
    "baseline.train", "completion", "dashboard", "demo", "doctor", "down", "drain", "encode",
    "iterate", "lab.contrast", "pause", "pipeline", "resume", "router", "serve", "spawn", "status",
    "stop", "sweep", "tasks", "train", "worker",
}  # fmt: skip


@pytest.fixture
def mark(tmp_path, monkeypatch):
    """A file that the module writes when it is imported, here or in a process that a verb starts."""
    mark, modules = tmp_path / "imported", tmp_path / "modules"
    modules.mkdir()
    (modules / f"{MARK}.py").write_text(f"open({str(mark)!r}, 'w').close()\n")
    monkeypatch.syspath_prepend(modules)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((str(modules), str(ROOT))))
    monkeypatch.setenv("DREAMFLEET_TRUST", "")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(pygame.event, "get", lambda: [pygame.event.Event(pygame.QUIT)])  # a window closes at once
    yield mark
    sys.modules.pop(MARK, None)


@pytest.fixture
def folder(tmp_path, monkeypatch, mark):
    """The current folder, with one file of each kind that names the module."""
    monkeypatch.chdir(tmp_path)
    small = Bundle.open(FIXTURES / "small.zip")
    parts = {name: small.read(name) for name in small.manifest.parts}
    for name, task in (("own", OWN), ("gym", GYM)):
        manifest = replace(small.manifest, task=task)
        bundle = write_bundle(tmp_path / f"{name}-bundle.zip", manifest, parts)
        controller = write_controller(tmp_path / f"{name}.npz", task)
        report = EvaluationReport(f"{name}.npz", controller.sha256, task, task, "", "f", "1", 1.0, DRIVES)
        (tmp_path / f"{name}.json").write_text(report.to_json())
        write_controller(tmp_path / f"{name}-seen" / "controller.npz", "car-racing", bundle)
        write_controller(tmp_path / f"{name}-dreamt" / "controller.npz", "dream", bundle)
        write_run(tmp_path / "runs" / name, bundle, task=task)
        write_run(tmp_path / "runs" / f"{name}-dreamt", bundle)
    write_controller(tmp_path / "nested.npz", "gym:CartPole-v1", options={"environment": {"env_id": f"{MARK}:X-v0"}})
    write_run(tmp_path / "runs" / "optimiser", small, optimiser=f"{MARK}:Optimiser")
    agent = AgentManifest("drqn", OWN, "box-64", ((0.0, 0.0, 0.0),), 1, 4)
    graph = GraphBuilder("agent")
    graph.add_output(graph.node("Identity", graph.constant(np.zeros((1, 1), np.float32))), "worth", 1, 1)
    TrainedAgent(agent, graph.build()).save(tmp_path / "agent.zip")
    command_line.main(["collect", "--data", "data", "--episodes", "2", "--steps", "5", "--jobs", "1"])
    return tmp_path


def write_controller(path, task, bundle=None, options=None):
    path.parent.mkdir(exist_ok=True)
    shape = bundle.controller_shape if bundle else ControllerShape(4, 2)
    parameters = np.zeros(shape.size, np.float32)
    text = json.dumps(options) if options else ""
    Controller(
        shape, parameters, task, bundle.sha256 if bundle else "", {"generation": 1, "steps": 1, "run_uid": "ab"}, text
    ).save(path)
    if bundle:
        shutil.copy(bundle.path, path.parent / "bundle.zip")
    return Controller.load(path)


def write_run(folder, bundle, **names):
    """The folder of a run of the dream whose journal names others."""
    shutil.copytree(FIXTURES / "runs" / "dream", folder)
    shutil.copy(bundle.path, folder / "bundle.zip")
    ((text,),) = change_journal(folder, "SELECT value FROM run WHERE key = 'settings'")
    settings = json.loads(text)
    task = {name: value for name, value in names.items() if name == "task"}
    settings |= names | {"task": settings["task"] | {"bundle": bundle.sha256} | task}
    change_journal(folder, "UPDATE run SET value = ? WHERE key = 'settings'", json.dumps(settings))
    change_journal(folder, "DELETE FROM run WHERE key = 'ended'")
    kept = Controller.load(folder / "controller.npz")
    provenance = kept.provenance | {"settings": settings}
    replace(kept, task=settings["task"]["task"], bundle=bundle.sha256, provenance=provenance).save(
        folder / "controller.npz"
    )


CONTROLLERS = ["own.npz", "gym.npz", "nested.npz"]
CONTROLLERS += [f"{name}-{way}/controller.npz" for name in ("own", "gym") for way in ("seen", "dreamt")]
BUNDLES = ["own-bundle.zip", "gym-bundle.zip"]
RUNS = ["own", "gym", "own-dreamt", "gym-dreamt", "optimiser"]


def beside(controller):
    """The world model in a controller's folder."""
    return "none" if "/" not in controller else f"{controller.partition('/')[0]}/bundle.zip"


def commands(port=0):
    short = ("--episodes", "1", "--jobs", "1")
    serve = ("--listen", f"tcp/127.0.0.1:{port}")  # which is in use, so that no run is served
    for file in (*CONTROLLERS, "agent.zip"):
        yield "evaluate", "--controller", file, *short
        yield "record", "--controller", file, "--steps", "1", "--out", "a.mp4"
        yield "live", "--controller", file, "--out", "pictures", "--seconds", "0.1"
    for file in CONTROLLERS:
        yield "collect", "--data", "new", "--controller", file, "--episodes", "2", "--jobs", "1"
        yield "lab", "refit", file, "--to", "tiny", "--data", "data", "--out", "b.npz"
        yield "coordinator", "--run", "x", "--init", file, "--bundle", beside(file), *serve
    for file in BUNDLES[:1]:
        yield "lab", "bench", "policy", "--bundle", file
        yield "lab", "bench", "dream", "--bundle", file
        yield "lab", "bench", "live", "--bundle", file
        yield "lab", "bench", "env", "--bundle", file, "--episodes", "1"
    for file in CONTROLLERS[:1]:
        yield "card", file, "--out", "card"
        yield "import", file, "--out", "converted", "--like", "tiny"
    for file in BUNDLES:
        yield "coordinator", "--run", "x", "--bundle", file, *serve
        yield "inspect", file, "--out", "page.html"
        yield "lab", "subspace", file, "--data", "data", "--out", "s.npz"
        yield "bundle", "--extract", file, "--data", "unbundled"
        yield "bundle", "--from", file, "--out", "rounded.zip"
        yield "drive", "--dream", "--bundle", file, "--steps", "1"
    yield "verify", "run", "optimiser", "--run", "again", *serve
    for run in RUNS:
        yield "coordinator", "--from", run, "--run", f"{run}-more", *serve
        own = ("--listen", "tcp/127.0.0.1:0") if run == "optimiser" else serve  # it is refused after it listens
        yield "coordinator", "--resume", run, *own
        yield "verify", "candidate", run, "--candidate", "1/0"
        yield "inspect", run, "--out", "page.html"
        yield "live", "--controller", run, "--generation", "3", "--out", "pictures", "--seconds", "0.1"
        yield "collect", "--data", "new", "--from-run", run
        yield "runs", "show", run
        yield "story", run, "--journal"
        yield "runs", "receipt", run
        yield "runs", "plot", run, "--out", "a.png"
        yield "runs", "export", run, "--csv", "--out", f"csv-{run}"
        yield "compare", run, "own"
        yield "bar", "nobody", run
        yield "runs", "backup", run, "--to", f"backup-{run}"
    yield "runs", "archive", "gym"
    yield "runs", "list"
    yield "runs", "delete", "own", "--yes"
    for report in ("own.json", "gym.json"):
        yield "verify", "report", report, "--episodes", "1", "--jobs", "1"
        yield "compare", report, report
        yield "bundle", "--data", "data", "--out", "c.zip", "--measured", report


def test_every_verb_is_tried_or_reads_no_names():
    tried = {".".join(words[: 2 if words[0] in ("runs", "lab", "verify") else 1]) for words in commands()}
    assert not tried & NAMELESS
    assert tried | NAMELESS == {each.name for each in entry_points(group=command_line.GROUP)}


def call(words, processes, capfd):
    """The exit code and stderr of a verb; one that serves a run changes the process, so it gets its own."""
    if words[0] == "coordinator" or words[:2] == ("verify", "run"):
        return processes.call(*words)[::2]
    try:
        code = command_line.main(list(words))
    except SystemExit as error:
        code = error.code
    return code, capfd.readouterr().err


@pytest.mark.long
def test_no_verb_imports_what_a_file_names(folder, mark, processes, capfd):
    refused = set()
    with socket.create_server(("127.0.0.1", 0)) as busy:
        for words in commands(busy.getsockname()[1]):
            code, said = call(words, processes, capfd)
            assert not mark.exists(), words
            assert "Traceback" not in said, (words, said)
            if f"--trust {MARK}" in said:
                assert code == 2, words
                refused.add(" ".join(words[: 2 if words[0] in ("lab", "verify") else 1]))
    assert refused >= {
        "coordinator", "evaluate", "inspect", "live", "record", "verify candidate", "verify report", "verify run",
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("file", "task"), [("own.npz", OWN), ("gym.npz", GYM)])
def test_what_the_user_names_is_imported(folder, mark, file, task):
    words = ["evaluate", "--controller", file, "--episodes", "1", "--jobs", "1"]
    code, _, err = call_here(*words)
    assert (code, f"--trust {MARK}" in err, err.count("\n")) == (2, True, 1), err
    assert not mark.exists()
    assert call_here(*words, "--trust", MARK)[0] == 2  # it has no such world
    assert mark.exists()
