"""The two sources of live frames: a worker that scores, and a controller that is driven for the viewer."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from time import monotonic, sleep
from typing import Any

from dreamfleet.common.addons.frames.live import LiveView
from dreamfleet.worker.addons.evaluation.agents import Agent
from dreamfleet.worker.addons.live.live_view import CaptionedFrame, LiveCanvas
from dreamfleet.worker.addons.recording.canvas import Frame
from dreamfleet.worker.addons.recording.drive_frames import film
from dreamfleet.worker.addons.recording.parallel_dream import ParallelDreamConfig
from dreamfleet.worker.tasks.closing import closing_environment

Driver = tuple[Agent, dict[str, Any]]
"""An agent, and the facts about it for captions."""


def worker_frames(view: LiveView, canvas: LiveCanvas, rate: float) -> Iterator[CaptionedFrame | None]:
    """Yield a worker's newest frame `rate` times a second until the run is over; the last one again if none is new.

    `None` before the first frame.
    """
    shown, due = None, monotonic()
    while not view.is_over:
        due = max(due + 1 / rate, monotonic())
        if (live_frame := view.next(max(0.0, due - monotonic()))) is not None:
            shown = canvas.draw(live_frame)
        sleep(max(0.0, due - monotonic()))
        yield shown


def driven_frames(
    driver: Callable[[], Driver], dreaming: ParallelDreamConfig, rate: float, seed: int
) -> Iterator[CaptionedFrame]:
    """Frames of whole episodes, one seed after another from `seed` on; `rate` frames show a second of the world.

    `driver` is called before each episode and may return another agent each time.
    """
    for track in count(seed):
        agent, facts = driver()
        with closing_environment(agent.make_evaluation_environment("rgb_array")) as environment:
            yield from _episode(agent, facts, environment, replace(dreaming, seed=track), rate)


def _episode(
    agent: Agent, facts: dict[str, Any], environment: Any, dreaming: ParallelDreamConfig, rate: float
) -> Iterator[CaptionedFrame]:
    """Frames of one episode; its seed is also the dream's."""
    world, drawn, score, facts = agent.world, list[Frame](), 0.0, {**facts, "seed": dreaming.seed}
    every = max(1, round(world.frames_per_second / rate))
    for moment in film(agent, environment, dreaming, world.horizon, drawn.append, every):
        if drawn:
            yield CaptionedFrame(drawn.pop(), {**facts, "step": moment.step - 1, "score": score})
        score += moment.reward
    for picture in drawn:
        yield CaptionedFrame(picture, {**facts, "step": moment.step, "score": score})


def limit_rate(pictures: Iterator[CaptionedFrame], rate: float) -> Iterator[CaptionedFrame]:
    """At most `rate` frames a second; after a slow frame the following ones are not hurried."""
    due = monotonic()
    for shown in pictures:
        sleep(max(0.0, due - monotonic()))
        due = max(due, monotonic()) + 1 / rate
        yield shown
