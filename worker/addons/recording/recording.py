"""Recording a drive as a video."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NoReturn

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.files.atomic_write import reporting_write_errors
from dreamfleet.common.host.process_pool import count_step, map_in_processes
from dreamfleet.common.host.stall_watch import STALL_SECONDS
from dreamfleet.common.host.stop_signals import Stop, never_stop
from dreamfleet.common.host.unseen_drawing import draw_unseen
from dreamfleet.worker.addons.evaluation.agents import Agent
from dreamfleet.worker.addons.recording.drive_frames import film
from dreamfleet.worker.addons.recording.parallel_dream import ParallelDreamConfig
from dreamfleet.worker.addons.recording.video import Video
from dreamfleet.worker.scoring.failure_cause import crash, failure_of
from dreamfleet.worker.tasks.closing import closing_environment

Recorder = partial[tuple[float, int]]
"""`record` with its agent, and all that `record_in_process` does not give."""


def record(
    agent: Agent, seed: int, steps: int, out: Path, dreaming: ParallelDreamConfig | None = None,
    on_step: Callable[[int], None] = lambda _steps: None, stop: Stop = never_stop,
) -> tuple[float, int]:  # fmt: skip
    """Record one episode of an agent in its evaluation environment as an mp4; return its score and its steps.

    With a world model, the video also shows what the model sees, decodes and, if it can, dreams. If `stop()`
    turns true, the video ends early, after at least one step.
    """
    config = replace(dreaming or ParallelDreamConfig(), seed=seed)
    score = 0.0
    environment = agent.make_evaluation_environment("rgb_array")  # first of all: what follows asks the open one
    with closing_environment(environment), Video(out, agent.world.frames_per_second) as video:
        for moment in film(agent, environment, config, steps, video.add):
            score += moment.reward
            on_step(moment.step)
            if stop():
                break
    return score, moment.step


def record_in_process(
    record_here: Recorder, seed: int, out: Path, on_step: Callable[[int], None], stop: Stop,
    stall: float = STALL_SECONDS,
) -> tuple[float, int]:  # fmt: skip
    """Record an episode in a child process; return its score and its steps.

    `DreamfleetError` if the episode fails, ends its process, or
    makes no step for `stall` seconds; then `out` is as it was before. `on_step` is called about once a second.
    """
    is_stopped = get_context("spawn").Value("B", 0, lock=False)

    def look(steps: int) -> None:
        on_step(steps)
        is_stopped.value = stop()

    def lose(_item: object, reason: int | str) -> NoReturn:
        raise DreamfleetError(f"the episode of seed {seed} failed: {crash(reason).text}")

    with reporting_write_errors(out), TemporaryDirectory(prefix=f".{out.stem}-", dir=out.parent) as folder:
        video = Path(folder).absolute() / out.name  # a simulator may change the current folder of its process
        items = [(record_here, seed, video)]
        (made,) = map_in_processes(1, draw_unseen, (), partial(_record, is_stopped), items, lose, stall, look)
        video.replace(out)
    return made


def _record(is_stopped: Any, item: tuple[Recorder, int, Path]) -> tuple[float, int]:
    """Record one episode in a child process until the parent stops it; return its score and its steps."""
    record_here, seed, out = item
    try:
        return record_here(seed=seed, out=out, on_step=count_step, stop=lambda: bool(is_stopped.value))
    except (KeyboardInterrupt, SystemExit, GeneratorExit) as error:  # of the simulator: no Ctrl-C raises here
        raise DreamfleetError(f"the episode of seed {seed} failed: {failure_of(error).text}") from error
