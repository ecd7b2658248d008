"""Scoring candidates in dreams on a torch device, such as a graphics processor.

Every batch has the same number of rows, filled up with its first one: torch chooses kernels by size, and only at one
size has a fitness the same bits alone and among others. They are not ONNX Runtime's bits, so a worker that dreams like
this is of a class of its own. Pages: decisions.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import one_line, truncate
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.addons.torch_dreams.torch_dream_step import StepNoise, TorchDreamStep
from dreamfleet.worker.dream.batch import TORCH_ROWS as ROWS
from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.dream.noise import BLOCK_STEPS, Draw, SharedNoise
from dreamfleet.worker.tasks.api import Score
from dreamfleet.worker.tasks.batches import Episode
from dreamfleet.worker.tasks.watching import StepSnapshot
from dreamfleet.worker.worldmodel.inference import NoiseSize

Floats = NDArray[np.float32]
WARM_UP = 3  # steps before a CUDA graph is captured, which torch asks for


class TorchDreamBatch(DreamBatch):
    """Scores batches of dreamt episodes on a torch device, in blocks of `BLOCK_STEPS` steps."""

    most_rows = ROWS

    def __init__(self, bundle: Bundle, spec: TaskSpec, device: str) -> None:
        """`UsageError` for a device that torch does not have here."""
        super().__init__(bundle, spec)
        found = find_device(device)
        step = TorchDreamStep(bundle, found, self._world.temperature)
        self._rows = _DreamRows(step, self._world.begin(ROWS), self._world.chance, self._size, found)

    def _dream(self, episodes: Sequence[Episode], on_step: Callable[[int], None], start: int) -> list[Score]:
        world, dreams, count = self._world, self._rows, len(episodes)
        full = [*episodes, *[episodes[0]] * (ROWS - count)]
        noise, sums = self._draw_noise(full), self._begin_sums(count)
        dreams.begin(self._stack(full), noise.episode, noise.first.latent, world.begin(ROWS, noise.first.memory))
        rows = np.arange(count)
        block = self._launch(noise, 0, noise.next_block(), 0)
        while block is not None and len(rows):
            action, reward, done = dreams.fetch(block.begun % BLOCK_STEPS, block.steps)
            # The device goes on while rewards are added up here; once all dreams are over, what it does is not used.
            after = self._launch(noise, block.begun + block.steps, block.draw, int(rows[0]))
            if block.seen is not None and self._observer is not None and block.row in rows:
                score = float(sums.fitness[block.row])
                shown = StepSnapshot(block.begun, score, action[0, block.row], None, *block.seen)
                self._observer.observe(start + block.row, lambda shown=shown: shown)  # type: ignore[misc]
            for index in range(block.steps):
                bars, drawn = block.draw.bar, block.begun % BLOCK_STEPS + index
                bar = None if bars is None else bars[drawn, noise.episode[rows]]
                paid, ended = world.judge(reward[index, rows], done[index, rows], bar)
                sums.add(rows, paid, action[index, rows])
                rows = rows[~ended]
            on_step(sums.made)
            block = after
        return sums.scores()

    def _launch(self, noise: SharedNoise, begun: int, draw: Draw, row: int) -> _Block | None:
        """Begin the block of steps after the first `begun`; `None` after the last one.

        A block ends with its `draw`, and where an observer wants to see `row`, it is a single step.
        """
        if begun >= self._horizon:
            return None
        drawn = begun % BLOCK_STEPS
        if begun and not drawn:
            draw = noise.next_block()
        seen = self._rows.show(row) if self._observer is not None and self._observer.is_due() else None
        steps = 1 if seen is not None else min(BLOCK_STEPS - drawn, self._horizon - begun)
        self._rows.launch(draw, drawn, steps)
        return _Block(begun, steps, draw, row, seen)


class _Block(NamedTuple):
    """Steps that the device makes without a look at the results: `steps` after the first `begun`.

    `seen` are latent and state of `row` before them, if an observer wants that.
    """

    begun: int
    steps: int
    draw: Draw
    row: int
    seen: tuple[Floats, Floats] | None


def find_device(name: str) -> torch.device:
    """The torch device with this name; `UsageError` if torch does not have it here."""
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()
    except Exception as error:  # torch's errors share no public base, and some are pages long
        what = truncate(one_line(str(error).partition("\n")[0]), 200)
        raise UsageError(f"torch_device {name!r}: torch {torch.__version__} cannot use it here ({what})") from error
    return device


class _DreamRows:
    """The `ROWS` dreams on the device, and the outputs of the last block of steps. On CUDA a step is one graph."""

    def __init__(
        self, step: TorchDreamStep, state: Floats, chance: NoiseSize, size: int, device: torch.device
    ) -> None:  # fmt: skip
        self._step, self._device = step, device
        self._latent, self._state = self._zeros(ROWS, chance.latent), torch.from_numpy(state).to(device)
        self._episode, self._index = (self._zeros(each, kind=torch.int64) for each in (ROWS, 1))
        block = (BLOCK_STEPS, ROWS)  # of steps and seeds, of which there are as many as rows at most
        mask = self._zeros(*block, chance.hidden) if chance.dropout else None
        self._noise = StepNoise(self._zeros(*block, chance.latent), self._zeros(*block, chance.latent), mask)
        step.set_parameters(np.zeros((ROWS, size), np.float32))
        with torch.no_grad():
            actions = step.step(self._latent, self._state, self._take_noise()).action.shape[1]
        self._outputs = (self._zeros(*block, actions), self._zeros(*block), self._zeros(*block))
        self._graph = None
        if device.type == "cuda":
            with torch.cuda.device(device):  # torch captures what the current device does
                self._graph = self._capture()

    def begin(self, parameters: Floats, episode: NDArray[np.int64], latent: Floats, state: Floats) -> None:
        """Start new dreams, one a row; `episode` `(ROWS,)` is each row's column in the draws."""
        self._step.set_parameters(parameters)
        for mine, given in ((self._episode, episode), (self._latent, latent), (self._state, state)):
            mine.copy_(torch.from_numpy(np.ascontiguousarray(given)))

    def show(self, row: int) -> tuple[Floats, Floats]:
        """A row's latent and state before the next step."""
        latent, state = (each[row].to("cpu", copy=True).numpy() for each in (self._latent, self._state))
        return latent, state

    def launch(self, draw: Draw, drawn: int, steps: int) -> None:
        """Begin to dream so many steps, by what a draw has after its first `drawn` ones."""
        for mine, given in zip(self._noise, (draw.uniform, draw.normal, draw.mask), strict=True):
            if mine is not None and given is not None and not drawn:  # else they are there
                mine[:, : given.shape[1]].copy_(torch.from_numpy(given))
        self._index.fill_(drawn)
        for _ in range(steps):
            self._graph.replay() if self._graph is not None else self._advance()

    def fetch(self, drawn: int, steps: int) -> tuple[Floats, Floats, Floats]:
        """Wait for these steps: the actions `(steps, ROWS, actions)`, and both heads' outputs `(steps, ROWS)`."""
        action, reward, done = (each[drawn : drawn + steps].to("cpu", copy=True).numpy() for each in self._outputs)
        return action, reward, done

    @torch.no_grad()
    def _advance(self) -> None:
        found = self._step.step(self._latent, self._state, self._take_noise())
        self._latent.copy_(found.latent)
        self._state.copy_(found.state)
        for kept, new in zip(self._outputs, (found.action, found.reward, found.done), strict=True):
            kept.index_copy_(0, self._index, new[None])
        self._index += 1

    def _take_noise(self) -> StepNoise:
        taken = self._index * ROWS + self._episode
        uniform, normal, mask = self._noise
        dropped = None if mask is None else mask.flatten(0, 1)[taken]
        return StepNoise(uniform.flatten(0, 1)[taken], normal.flatten(0, 1)[taken], dropped)

    def _capture(self) -> torch.cuda.CUDAGraph:
        stream = torch.cuda.Stream(self._device)  # type: ignore[no-untyped-call]
        stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP):
                self._advance()
        torch.cuda.current_stream(self._device).wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self._advance()
        return graph

    def _zeros(self, *sizes: int, kind: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.zeros(sizes, dtype=kind, device=self._device)
