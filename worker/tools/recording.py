"""A drive as a video: the track, what the model sees of it, what it makes of that, and what it dreams."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.controller import Controller
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.stopping import Stop, never
from dreamfleet.worker.car_racing.task import CarRacing
from dreamfleet.worker.dream.daydream import Daydream, DaydreamConfig, can_dream
from dreamfleet.worker.tools.canvas import AWAKE, DREAMING, Canvas, Dreamt, Layout, Moment
from dreamfleet.worker.worldmodel.inference import Decoder

FRAMES_PER_SECOND = 50  # CarRacing's own
TASKS = ("car-racing", "dream")  # what was evolved in a dream drives in reality too


def record(
    controller: Controller, bundle: Bundle, seed: int, steps: int, out: Path,
    dreaming: DaydreamConfig | None = None, on_step: Callable[[int], None] = lambda _steps: None,
    stop: Stop = never,
) -> float:  # fmt: skip
    """Drive one episode in gymnasium's own environment into an mp4; returns its score.

    A bundle that can dream does so beside the drive. If `stop` asks for it, the video ends early, with a step at least.
    """
    if controller.task not in TASKS:
        raise UsageError(f"only {' and '.join(TASKS)} can be recorded, not {controller.task}")
    task = CarRacing()
    environment = task.make_judge(bundle, "rgb_array")
    policy, decoder = task.make_policy(bundle), Decoder(bundle)
    daydream = None
    if can_dream(bundle):
        daydream = Daydream(bundle, controller.parameters, dreaming or DaydreamConfig(seed=seed))
    policy.begin(controller.parameters)
    observation, _ = environment.reset(seed=seed)
    layout = DREAMING if daydream else AWAKE
    canvas = Canvas(seed, layout)
    score, step, ended = 0.0, 0, False
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        container = av.open(str(out), "w")
    except OSError as error:
        raise DatasetError(f"cannot write {out}: {error.strerror}; choose another --out") from error
    with container:
        stream = _open_stream(container, layout)
        while step < steps and not ended and not (step and stop()):
            state = policy.state
            action = policy.act(observation)
            decoded, dreamt = decoder.decode(policy.latent)[0], None
            if daydream is not None:
                imagined = daydream.follow(step, policy.latent, state)
                dreamt = Dreamt(decoder.decode(imagined)[0], daydream.since)
            track: Any = environment.render()
            frame = canvas.draw(Moment(track, observation, decoded, action, step, score, dreamt))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "rgb24")))
            observation, reward, terminated, truncated, _ = environment.step(action)
            policy.reward(float(reward))
            score, step, ended = score + float(reward), step + 1, terminated or truncated
            on_step(step)
        container.mux(stream.encode())
    environment.close()
    return score


def _open_stream(container: Any, layout: Layout) -> Any:
    stream = container.add_stream("libx264", rate=FRAMES_PER_SECOND)
    stream.width, stream.height = layout.size
    stream.pix_fmt = "yuv420p"
    stream.time_base = Fraction(1, FRAMES_PER_SECOND)
    stream.options = {"crf": "23", "preset": "veryfast"}
    return stream
