"""Find whom to evaluate, record or watch: a controller, or a baseline. Pages: sources.md, baselines.md."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.regular_files import is_file, path_exists
from dreamfleet.common.host.add_ons import add_on, find_add_on
from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
from dreamfleet.worker.worlds.trained_agent import TrainedAgent, is_agent

if TYPE_CHECKING:
    from dreamfleet.worker.addons.evaluation.agents import Agent

RANDOM, DISCRETE = "random", "random-discrete"


def find_driver(
    name: str,
    runs_dir: Path,
    bundle: str | None = None,
    task: str | None = None,
    options: Mapping[str, Any] | None = None,
) -> Agent:
    """The agent of this name: what `find_agent` finds, a random driver, or the network in its training's folder.

    `bundle` names another world model than the controller's own. `task` and the task's `options` are the world of a
    random driver, by default the first world. `UsageError` where they do not apply, `DatasetError` for a damaged or
    foreign checkpoint.
    """
    if is_random(name, runs_dir):
        _refuse(bundle, name)
        return make_random_agent(name, task, options or {})
    if task is not None or options:
        raise UsageError(
            f"--task and --environment are the world of --controller {RANDOM}; {name} has a world of its own"
        )
    find_network = find_add_on("trained-network")
    network: Agent | None = find_network(Path(name)) if find_network else None
    if network is not None:
        _refuse(bundle, name)
        return network
    # Heavy, and `baseline train --help` reads this module too.
    from dreamfleet.worker.addons.evaluation.agents import make_agent

    controller, beside = find_agent(name, runs_dir)
    if isinstance(controller, TrainedAgent):
        _refuse(bundle, name)
        return make_agent(controller, None)
    return make_agent(controller, find_bundle_of(controller, bundle, beside))


def _refuse(bundle: str | None, name: str) -> None:
    if bundle is not None:
        raise UsageError(f"--controller {name} has no world model beside it: omit --bundle")


def find_agent(name: str, runs_dir: Path) -> tuple[Controller | TrainedAgent, Path | None]:
    """The controller or trained agent of this name, and the path beside it where a bundle may be."""
    path = Path(name)
    return (TrainedAgent.load(path), None) if is_file(path) and is_agent(path) else find_controller(name, runs_dir)


def is_random(name: str, runs_dir: Path) -> bool:
    """Whether this is the name of a random driver, and of no file and no run."""
    return name in (RANDOM, DISCRETE) and not (path_exists(Path(name)) or path_exists(runs_dir / name))


def make_random_agent(name: str, task: str | None, options: Mapping[str, Any]) -> Agent:
    """The random driver of this name in a task, by default the first world; `UsageError` if it needs a world model."""
    agent: Agent = add_on("random-agent")(name, task, options)
    return agent
