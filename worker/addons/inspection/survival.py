"""Measure whether fixed policies live as long in a world model's dreams as in its world.

A controller evolves for what its dreams punish. If a policy that ignores pictures lives far longer there than in
reality, dreams are too easy. It needs no true state, so it tests world models of any world that ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.addons.inspection.encoded_rollout import ConstantDriver
from dreamfleet.worker.addons.inspection.probe import Estimate, Table
from dreamfleet.worker.addons.recording.canvas import choice_name
from dreamfleet.worker.dream.batch import MAX_ROWS
from dreamfleet.worker.dream.noise import SharedNoise
from dreamfleet.worker.dream.world import DreamEnds, DreamWorld
from dreamfleet.worker.scoring.disturbance import numbered_choices
from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.tasks.api import Assignment, Driver, Task, World
from dreamfleet.worker.tasks.closing import closing_environment
from dreamfleet.worker.tasks.model_free_policies import NO_PARAMETERS, DriverPolicy
from dreamfleet.worker.tasks.registry import task_of

Lengths = NDArray[np.int64]
DriverMaker = Callable[[np.random.Generator], Driver]
LONGEST = 3000  # steps at which episodes of worlds without a shorter limit are cut, real and dreamt
MOST_CHOICES = 8
CONTROLLER = "controller"  # the name of its row


@dataclass(frozen=True)
class SurvivalConfig:
    """So many real and so many dreamt episodes of each policy, their first seed, and the dreams' settings.

    `end` is a rule in place of the bundle's, as in `EndRule.parse`; empty: the bundle's own.
    """

    episodes: int = 40
    first_seed: int = 0
    temperature: float = 1.0
    end: str = ""

    @property
    def seeds(self) -> range:
        """The seeds of the episodes."""
        return range(self.first_seed, self.first_seed + self.episodes)


@dataclass(frozen=True)
class PolicySurvival:
    """Steps that one policy lives: means over real and dreamt episodes, and the shares of these that a limit cut.

    `ratio` is the dreamt mean over the real one.
    """

    policy: str
    real: Estimate
    dreamt: Estimate
    ratio: Estimate
    real_cut: float
    dreamt_cut: float

    @classmethod
    def of(cls, policy: str, real: Lengths, dreamt: Lengths, limit: int) -> PolicySurvival:
        """From the lengths of episodes; those of `limit` steps were cut."""
        lived, dreamed = (Estimate.of(each.tolist()) for each in (real, dreamt))
        ratio, error = dreamed.value / lived.value, None
        if lived.error is not None and dreamed.error is not None:
            error = ratio * math.hypot(lived.error / lived.value, dreamed.error / dreamed.value)
        cut = [float((each >= limit).mean()) for each in (real, dreamt)]
        return cls(policy, lived, dreamed, Estimate(ratio, error), *cut)


@dataclass(frozen=True)
class Survival:
    """Each policy's survival, and how well dreams agree with reality over all of them.

    `agreement` is minus the mean of the ratios' logarithms without sign: 0 where each policy lives equally long in
    both, -0.69 where it lives twice or half as long in dreams. `limit` is the length at which episodes are cut. It is
    of so many `episodes` of each policy, in dreams of this `temperature`.
    """

    episodes: int
    temperature: float
    limit: int
    end: str
    policies: tuple[PolicySurvival, ...]
    agreement: Estimate

    @classmethod
    def of(cls, config: SurvivalConfig, limit: int, end: str, policies: tuple[PolicySurvival, ...]) -> Survival:
        """From the policies, whose errors are independent."""
        value = -float(np.mean([abs(math.log(each.ratio.value)) for each in policies]))
        errors = [None if each.ratio.error is None else each.ratio.error / each.ratio.value for each in policies]
        known = [each for each in errors if each is not None]
        error = math.hypot(*known) / len(policies) if len(known) == len(errors) else None
        return cls(config.episodes, config.temperature, limit, end, policies, Estimate(value, error))

    def table(self) -> Table:
        """As rows, and a text that describes them."""
        rows = [
            {
                "policy": each.policy,
                "reality": str(each.real),
                "dream": str(each.dreamt),
                "dream / reality": str(each.ratio),
                "cut, reality": f"{each.real_cut:.0%}",
                "cut, dream": f"{each.dreamt_cut:.0%}",
            }
            for each in self.policies
        ]
        return rows, (
            f"mean steps ± standard error of {self.episodes} real and {self.episodes} dreamt episodes each, cut at "
            f"{self.limit}; temperature {self.temperature:g}, end {self.end}; agreement {self.agreement} (0: equally "
            "long everywhere, -0.69: twice or half as long)"
        )


def measure_survival(
    bundle: Bundle, controller: Controller | None, config: SurvivalConfig,
    on_episode: Callable[[int], None] = lambda _count: None,
) -> Survival:  # fmt: skip
    """Compare how long each fixed policy, and the controller if there is one, lives in reality and in dreams.

    `UsageError` for a world model that predicts no ends, or for a controller of another one. `on_episode` gets the
    number of episodes so far, first of those in the world and then of dreams.
    """
    if not bundle.manifest.models.get("mdnrnn", {}).get("done"):
        raise UsageError(f"{bundle.path.name} predicts no ends: train its MDN-RNN with --set done=true")
    if controller is not None and controller.bundle != bundle.sha256:
        raise UsageError("the controller must be of this world model, as it acts in its dreams too")
    fitting = bundle if controller is None else bundle.for_controller(controller)
    task, assignment = task_of(bundle), Assignment.of(bundle.manifest.task, fitting)
    world = DreamWorld(fitting, config.temperature, end=config.end)
    rule = DreamEnds(bundle, config.temperature, config.end).rule.text
    drivers: dict[str, DriverMaker | None] = {**fixed_drivers(task, task.world_of(assignment))}
    if controller is not None:
        drivers[CONTROLLER] = None
    lengths, limit = _real_lengths(task, assignment, drivers, controller, config.seeds, on_episode)
    found = []
    for (name, make), real in zip(drivers.items(), lengths, strict=True):
        dreamt = _dream_lengths(world, make, controller, config.seeds, limit)
        found.append(PolicySurvival.of(name, real, dreamt, limit))
        on_episode((len(drivers) + len(found)) * len(config.seeds))
    return Survival.of(config, limit, rule, tuple(found))


def fixed_drivers(task: Task, world: World) -> dict[str, DriverMaker]:
    """Drivers by name: each choice for ever, or each action at its bounds and all at their middle; then the world's.

    Of many choices the first `MOST_CHOICES`.
    """
    actions, names = world.actions, world.action_names
    if not isinstance(actions, Continuous):
        raise UsageError(f"the actions of {task.name} are numbers: a dream needs vectors")
    found: dict[str, tuple[float, ...]] = {}
    if len(choices := numbered_choices(actions)[:MOST_CHOICES]):
        found = {f"always {choice_name(row, names, actions)}": tuple(actions.to_numbers(row)) for row in choices}
    else:
        middle = [(low + high) / 2 for low, high in zip(actions.low, actions.high, strict=True)]
        found["always the middle"] = tuple(middle)
        for index, bounds in enumerate(zip(actions.low, actions.high, strict=True)):
            name = names[index] if names else f"action {index + 1}"
            for bound in bounds:
                found[f"always {name} {bound:g}"] = (*middle[:index], bound, *middle[index + 1 :])
    constants = {name: _constant(action, world) for name, action in found.items()}
    return {**constants, **getattr(task, "drivers", {})}


def _constant(action: Sequence[float], world: World) -> DriverMaker:
    driver = ConstantDriver(action, world)
    return lambda _random: driver


def _real_lengths(
    task: Task, assignment: Assignment, drivers: Mapping[str, DriverMaker | None], controller: Controller | None,
    seeds: Sequence[int], on_episode: Callable[[int], None],
) -> tuple[list[Lengths], int]:  # fmt: skip
    """The lengths `(seeds,)` of episodes in the world under each driver, or the controller, and the longest possible.

    That limit falls to the simulator's where this ends an episode by one.
    """
    limit, lengths = min(task.world_of(assignment).horizon, LONGEST), list[int]()
    policy = task.make_policy(assignment)
    with closing_environment(task.make_environment(assignment)) as environment:
        for make in drivers.values():
            for seed in seeds:
                actor = policy if make is None else DriverPolicy(make(np.random.default_rng(seed)))
                actor.begin(NO_PARAMETERS if controller is None else controller.parameters)
                *_, last = run_episode(environment, actor, EpisodeConfig(seed, limit))
                lengths.append(last.step)
                on_episode(len(lengths))
                if last.ended and not last.terminal:
                    limit = last.step
    return list(np.array(lengths).reshape(len(drivers), len(seeds))), limit


def _dream_lengths(
    world: DreamWorld, make: DriverMaker | None, controller: Controller | None, seeds: Sequence[int], limit: int
) -> Lengths:
    """The lengths `(seeds,)` of dreams under a driver, or under the controller."""
    parts = [seeds[start : start + MAX_ROWS] for start in range(0, len(seeds), MAX_ROWS)]
    return np.concatenate([_dream_side_by_side(world, make, controller, part, limit) for part in parts])


def _dream_side_by_side(
    world: DreamWorld, make: DriverMaker | None, controller: Controller | None, seeds: Sequence[int], limit: int
) -> Lengths:
    drivers = [] if make is None else [make(np.random.default_rng(seed)) for seed in seeds]
    noise = SharedNoise(np.array(seeds), world.chance, world.start_states, world.bars)
    rows, lengths = np.arange(len(seeds)), np.full(len(seeds), limit)
    latent, state = noise.first.latent, world.begin(len(rows), noise.first.memory)
    for step in range(1, limit + 1):
        draw = noise.next(rows)
        if controller is not None and make is None:
            parameters = np.repeat(controller.parameters[None], len(rows), axis=0)
            moment = world.step_controllers(latent, parameters, state, draw)
        else:
            moment = world.imagine(latent, np.stack([drivers[row].act() for row in rows]), state, draw)
        lengths[rows[moment.done]] = step
        going = ~moment.done
        rows, latent, state = rows[going], moment.latent[going], moment.state[going]
        if not len(rows):
            break
    return lengths
