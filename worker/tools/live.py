"""The two things that can be watched live: what a worker scores, and a controller that is driven for the viewer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from time import monotonic, sleep
from typing import Any

from dreamfleet.common.live import LiveView
from dreamfleet.worker.dream.daydream import DaydreamConfig
from dreamfleet.worker.scoring.agents import Agent
from dreamfleet.worker.scoring.episode import Course, play
from dreamfleet.worker.tools.canvas import Frame
from dreamfleet.worker.tools.filming import Filmed, Painter, Thoughts
from dreamfleet.worker.tools.glass import Glass, Shown

Driver = tuple[Agent, dict[str, Any]]
"""Who drives, and the facts about him."""


def watched(view: LiveView, glass: Glass, rate: float) -> Iterator[Shown | None]:
    """What a worker does, `rate` times a second until the run is over: the newest there is, again if nothing is newer.

    `None` before the first frame.
    """
    shown, due = None, monotonic()
    while not view.over:
        due = max(due + 1 / rate, monotonic())
        if (sight := view.next(max(0.0, due - monotonic()))) is not None:
            shown = glass.show(sight)
        sleep(max(0.0, due - monotonic()))
        yield shown


def driven(driver: Callable[[], Driver], dreaming: DaydreamConfig, rate: float, seed: int) -> Iterator[Shown]:
    """Whole episodes on track after track from `seed` on, at the speed of the world where `rate` are shown a second.

    `driver` is asked before each episode, and may be another each time.
    """
    for track in count(seed):
        agent, facts = driver()
        environment = agent.make_judge("rgb_array")
        try:
            yield from _episode(agent, facts, environment, replace(dreaming, seed=track), rate)
        finally:
            environment.close()


def _episode(
    agent: Agent, facts: dict[str, Any], environment: Any, dreaming: DaydreamConfig, rate: float
) -> Iterator[Shown]:
    """One episode; the seed is the dream's too."""
    seed, world, drawn = dreaming.seed, agent.world, list[Frame]()
    policy: Any = agent.make_policies()(seed)
    policy.begin(agent.parameters)
    thoughts = None if agent.bundle is None else Thoughts(agent.bundle, policy, agent.parameters, dreaming)
    every = max(1, round(world.frames_per_second / rate))
    painter = Painter(environment, world, seed, drawn.append, every)
    score = 0.0
    for moment in play(environment, Filmed(policy, painter, thoughts), Course(seed, world.horizon)):
        if drawn:
            yield Shown(drawn.pop(), {**facts, "seed": seed, "step": moment.step - 1, "score": score})
        score += moment.reward


def paced(pictures: Iterator[Shown], rate: float) -> Iterator[Shown]:
    """At most `rate` a second: what is slower than that stays slow, and nothing is made up for."""
    due = monotonic()
    for shown in pictures:
        sleep(max(0.0, due - monotonic()))
        due = max(due, monotonic()) + 1 / rate
        yield shown
