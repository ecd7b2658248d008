"""Measure whether dreams that begin shortly before a real loss of the road lose it too.

Probes estimate from [z, h] whether a dream is off the road. They are also applied to real steps that they were not
fitted on, and to dreams that begin where reality stays on the road, so that their own errors show.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural
from dreamfleet.worker.addons.inspection.disturbed_rollouts import (
    OFF,
    OFFSET,
    DisturbedDrive,
    DisturbedDriveConfig,
    first_sustained,
)
from dreamfleet.worker.addons.inspection.drive_dreams import DreamSegment, DriveDreamer
from dreamfleet.worker.addons.inspection.probe import Estimate, LinearProbe, folds, other_rows
from dreamfleet.worker.dream.world import check_temperature

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
FOLDS = 10  # many, because linear probes are fast to fit and steps off the road are rare
PATIENCE = 10  # most drives per wanted loss
CALM = "no loss"  # name of the beginnings after which reality stays on the road
Kinds = list[tuple[str, dict[int, DreamSegment]]]


@dataclass(frozen=True)
class RoadLossConfig:
    """How many losses to find, how many steps before each dreams begin, how many dreams of each, and temperature."""

    losses: int = 30
    before: tuple[int, ...] = (40, 20, 0)
    dreams: int = 8
    temperature: float = 1.0

    def __post_init__(self) -> None:
        check_temperature(self.temperature)


@dataclass(frozen=True)
class RoadLossComparison:
    """Means over the beginnings of one kind, by figure and source.

    `reality` is the simulator's true state; `foreseen` are probe and reward head on real steps predicted one step
    ahead. `dream` is under the controller with the real disturbance, `same_actions` under the real actions.
    """

    begun: str
    count: int
    figures: dict[str, dict[str, Estimate]]


@dataclass(frozen=True)
class LossReport:
    """Each kind of beginning, and of how many drives, dreams of each, and which temperature; `lasting` as of drives."""

    drives: int
    dreams: int
    temperature: float
    lasting: int
    begun: tuple[RoadLossComparison, ...]


@dataclass(frozen=True)
class RoadOutcome:
    """What happened from a beginning on, for each dream `(dreams, steps)`; reality has one row.

    `off`: whether the car is off the road. `offset`: its distance from the centre line. `reward`: of each step.
    """

    off: NDArray[np.bool_]
    offset: Doubles
    reward: Doubles

    def summarise(self, lasting: int) -> dict[str, float]:
        """Means over the dreams. `lasting` steps off the road in a row count as lost; the end is the last `lasting`."""
        return {
            "lost": float((first_sustained(self.off, lasting) >= 0).mean()),
            "off_at_end": float(self.off[:, -lasting:].mean()),
            "offset_at_end": float(self.offset[:, -lasting:].mean()),
            "reward": float(self.reward.sum(axis=1).mean()),
        }


class RoadProbe:
    """Linear probe of being off the road and of the distance from its centre line.

    Dreamt latents are sampled and noisier than a picture's. So the probe is fitted on [z, h] that the model predicts
    one step ahead of real ones, with the true state of the predicted step.
    """

    def __init__(self, drives: Sequence[DisturbedDrive], foreseen: Sequence[Floats], opening: int) -> None:
        features = np.concatenate([each[opening:] for each in foreseen])
        off = np.concatenate([drive.truth[OFF][opening:] for drive in drives])
        offset = np.abs(np.concatenate([drive.truth[OFFSET][opening:] for drive in drives]))
        often = min(max(float(off.mean()), 1e-6), 1 - 1e-6)
        balanced = np.where(off > 0, 0.5 / often, 0.5 / (1 - often))  # both classes weigh the same
        self._probe = LinearProbe.fit(features, np.stack([off, offset], axis=1), balanced)

    def outcome(self, features: Floats, reward: Doubles) -> RoadOutcome:
        """The outcome of features `(rows, steps, features)` with rewards `(rows, steps)`."""
        predicted = self._probe.predict(features.astype(np.float64))
        return RoadOutcome(predicted[..., 0] > 0.5, predicted[..., 1], reward)


def collect_losing_drives(
    drives: Iterator[DisturbedDrive], config: RoadLossConfig, driven: DisturbedDriveConfig,
    on_loss: Callable[[int], None] = lambda _losses: None,
) -> list[DisturbedDrive]:  # fmt: skip
    """Collect drives until `config.losses` have lost the road; `UsageError` if ten times as many drives have not."""
    taken, losses = list[DisturbedDrive](), 0
    for drive in islice(drives, PATIENCE * config.losses):
        if lacking := {OFF, OFFSET} - drive.truth.keys():
            raise UsageError(
                f"the world's true state lacks {' and '.join(sorted(lacking))}: losses of the road cannot be seen"
            )
        taken.append(drive)
        losses += has_usable_loss(drive, config, driven)
        on_loss(losses)
        if losses == config.losses:
            return taken
    raise UsageError(
        f"{plural(len(taken), 'drive')} lost the road {plural(losses, 'time')}, not {config.losses}: raise "
        "--noise, or ask for fewer"
    )


def compare_losses(
    drives: Sequence[DisturbedDrive],
    bundle: Bundle,
    controller: Controller,
    config: RoadLossConfig,
    driven: DisturbedDriveConfig,
) -> LossReport:
    """Compare losses, and stretches without one, with dreams begun there, by probes fitted on other folds' drives."""
    dreamer = DriveDreamer(bundle, controller, config.temperature, config.dreams)
    foreseen = [dreamer.predict_next(drive) for drive in drives]
    probes = dict[int, RoadProbe]()
    for fold in folds(len(drives), most=FOLDS):
        rest = other_rows(fold, len(drives))
        probe = RoadProbe([drives[row] for row in rest], [foreseen[row][0] for row in rest], driven.opening)
        probes |= dict.fromkeys(fold, probe)
    found = []
    for name, beginnings in _dream_segments(drives, config, driven):
        outcomes = [_outcomes(each, foreseen[row], dreamer, probes[row]) for row, each in beginnings.items()]
        found.append(RoadLossComparison(name, len(outcomes), _average(outcomes, driven.lasting)))
    return LossReport(len(drives), config.dreams, config.temperature, driven.lasting, tuple(found))


def _average(outcomes: Sequence[dict[str, RoadOutcome]], lasting: int) -> dict[str, dict[str, Estimate]]:
    summaries = [{where: outcome.summarise(lasting) for where, outcome in each.items()} for each in outcomes]
    return {
        figure: {where: Estimate.of([each[where][figure] for each in summaries]) for where in summaries[0]}
        for figure in summaries[0]["reality"]
    }


def _outcomes(
    begun: DreamSegment, foreseen: tuple[Floats, Doubles], dreamer: DriveDreamer, probe: RoadProbe
) -> dict[str, RoadOutcome]:
    drive, steps = begun.drive, begun.steps
    off, offset, reward = (each[None, steps] for each in (drive.truth[OFF], drive.truth[OFFSET], drive.reward))
    held, foretold = foreseen
    return {
        "reality": RoadOutcome(off > 0, np.abs(offset), reward),
        "foreseen": probe.outcome(held[None, steps], foretold[None, steps]),
        "dream": probe.outcome(*dreamer.dream(begun, own=True)),
        "same_actions": probe.outcome(*dreamer.dream(begun, own=False)),
    }


def _dream_segments(drives: Sequence[DisturbedDrive], config: RoadLossConfig, driven: DisturbedDriveConfig) -> Kinds:
    """Each kind of beginning by name, with its segments by the drives' rows."""
    lost = {row: drive for row, drive in enumerate(drives) if has_usable_loss(drive, config, driven)}
    kinds: Kinds = []
    for before in config.before:
        begun = {
            row: DreamSegment(drive, (drive.lost or 0) - before, before + driven.after) for row, drive in lost.items()
        }
        kinds.append((f"{plural(before, 'step')} before", begun))
    found = {
        row: _find_calm_stretch(drive, max(config.before) + driven.after, driven.opening)
        for row, drive in enumerate(drives)
    }
    calm = {row: each for row, each in found.items() if each is not None}
    return [*kinds, (CALM, calm)] if len(calm) > 1 else kinds


def _find_calm_stretch(drive: DisturbedDrive, length: int, opening: int) -> DreamSegment | None:
    """A random stretch of a drive, by its seed, on which it is never off the road; `None` if there is none."""
    steps = np.arange(opening, len(drive) - length + 1)
    off = np.concatenate([[0], np.cumsum(drive.truth[OFF])])
    calm = steps[off[steps + length] == off[steps]]
    return DreamSegment(drive, int(np.random.default_rng(drive.seed).choice(calm)), length) if len(calm) else None


def has_usable_loss(drive: DisturbedDrive, config: RoadLossConfig, driven: DisturbedDriveConfig) -> bool:
    """Whether the drive lost the road with enough steps before and after."""
    if drive.lost is None:
        return False
    return drive.lost - max(config.before) >= driven.opening and drive.lost + driven.after <= len(drive)
