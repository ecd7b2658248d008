"""Functions for users' own programs, which the package `dreamfleet` exports."""

from pathlib import Path
from typing import Any

import gymnasium

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.host.trusted_modules import trust_meanwhile
from dreamfleet.common.protocol.function_values import minimises
from dreamfleet.common.runs import lookup, run_paths
from dreamfleet.common.runs.episode_results import EpisodeResults
from dreamfleet.common.runs.seeds import TEST
from dreamfleet.worker.addons.evaluation import evaluation
from dreamfleet.worker.addons.evaluation.agents import Agent, make_agent
from dreamfleet.worker.tasks.api import Policy
from dreamfleet.worker.worlds.trained_agent import TrainedAgent


def find_controller(name: str, runs_dir: Path | str | None = None) -> Controller:
    """A controller by the name of a file, of a run, or of one that ships; `ControllerError` lists those that ship.

    >>> from dreamfleet import find_controller
    >>> find_controller("tiny").parameters.shape
    (867,)
    """
    folder = run_paths.default_runs_dir() if runs_dir is None else Path(runs_dir)
    controller, _ = lookup.find_controller(name, folder)
    return controller


def find_agent(path: Path | str) -> TrainedAgent:
    """A trained agent that `dreamfleet baseline export` wrote. The functions here take it like a controller.

    >>> from dreamfleet import find_agent
    >>> agent = find_agent("drqn.zip")
    >>> agent.task, len(agent.manifest.choices)
    ('car-racing', 5)
    """
    return TrainedAgent.load(Path(path))


def make_environment(
    controller: Controller | TrainedAgent, bundle: Bundle | None = None, render_mode: str | None = None
) -> gymnasium.Env[Any, Any]:
    """The environment that a controller is evaluated in, with the observations that its policy takes.

    >>> from dreamfleet import find_controller, make_environment
    >>> environment = make_environment(find_controller("tiny"))
    >>> observation, info = environment.reset(seed=1)
    >>> observation.shape
    (64, 64, 3)
    >>> environment.close()
    """
    with trust_meanwhile():
        return _agent(controller, bundle).make_evaluation_environment(render_mode)


def make_policy(controller: Controller | TrainedAgent, bundle: Bundle | None = None) -> Policy:
    """The policy of a controller, with its first episode started; `act(observation)` returns the next action.

    If the policy has a method `reward`, call it with the reward of each action; some world models use it.

    >>> from dreamfleet import find_controller, make_environment, make_policy
    >>> controller = find_controller("tiny")
    >>> environment, policy = make_environment(controller), make_policy(controller)
    >>> observation, info = environment.reset(seed=1)
    >>> observation, reward, terminated, truncated, info = environment.step(policy.act(observation))
    >>> policy.reward(reward)
    >>> environment.close()
    """
    with trust_meanwhile():
        agent = _agent(controller, bundle)
        policy = agent.make_policies()(0)
    policy.begin(agent.parameters)
    return policy


def evaluate(
    controller: Controller | TrainedAgent, bundle: Bundle | None = None, episodes: int = 100,
    first_seed: int = TEST.start, jobs: int | None = None,
) -> EpisodeResults:  # fmt: skip
    """Evaluate a controller in whole episodes, one a seed, in `jobs` processes (default: one a core).

    This is what `dreamfleet evaluate` does. With more than one job, call it under `if __name__ == "__main__":` in a
    script, because processes are spawned. The result's `failed` holds the episodes that failed in a fresh process too;
    with one job, which drives in this process, in a fresh environment. `DreamfleetError` if no episode has a score.

    >>> from dreamfleet import evaluate, find_controller
    >>> results = evaluate(find_controller("cartpole"), episodes=3, jobs=1)  # the name of a run of yours
    >>> len(results.scores), results.steps > 0
    (3, True)
    """
    if episodes < 1 or first_seed < 0 or (jobs is not None and jobs < 1):
        raise UsageError("episodes and jobs must be at least 1, first_seed at least 0")
    seeds = tuple(range(first_seed, first_seed + episodes))
    with trust_meanwhile():
        agent = _agent(controller, bundle)
        found = evaluation.evaluate(agent, seeds, jobs or usable_cores())
        return EpisodeResults.of(found, minimised=minimises(agent.task, agent.options))


def _agent(controller: Controller | TrainedAgent, bundle: Bundle | None) -> Agent:
    if bundle is None and isinstance(controller, Controller):
        bundle = lookup.find_bundle_of(controller, None)
    return make_agent(controller, bundle)
