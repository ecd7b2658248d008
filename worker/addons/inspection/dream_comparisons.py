"""Compare real drives with dreams that begin on them: do both lose the road, and are large values as frequent.

Probes estimate from [z, h] whether a dream is off the road, and other quantities. They are fitted on other drives, on
latents predicted one step ahead. They are also applied to real steps, and to dreams that begin where reality stays on
the road, so that their own errors show.

A dream may be plausible from step to step and yet contain fewer or milder bends than the world, and controllers evolve
for what it contains.
"""

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
    DreamSegment,
    DriveDreamer,
    first_sustained,
)
from dreamfleet.worker.addons.inspection.probe import Estimate, LinearProbe, Table, folds
from dreamfleet.worker.dream.world import check_temperature

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
FOLDS = 10  # many, because linear probes are fast to fit and steps off the road are rare
MAX_DRIVES = 10  # most drives per wanted loss
CALM = "no loss"  # as iteration/gate.py knows it: name of the beginnings after which reality stays on the road
BEGUN = {"0 steps before": "at the loss", CALM: "where nothing is lost"}  # clearer words for some beginnings
WHERE = {
    "reality": "reality",
    "foreseen": "reality, foreseen",
    "dream": "dream",
    "same_actions": "dream, reality's actions",
}
WHAT = {"lost": "road lost", "off_at_end": "off at the end", "offset_at_end": "offset at the end", "reward": "reward"}
RARE = 0.9  # quantile of a quantity's absolute value in reality above which it counts as rare
SHORTEST = 100  # steps on the road that a drive must have, to be compared with dreams
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

    def table(self) -> Table:
        """As rows, and a text that describes them."""
        rows = [
            {"begun": BEGUN.get(each.begun, each.begun), "n": each.count, "mean": WHAT[figure]}
            | {WHERE[where]: str(estimate) for where, estimate in by_source.items()}
            for each in self.begun
            for figure, by_source in each.figures.items()
        ]
        return rows, (
            f"means ± standard errors over n beginnings in {plural(self.drives, 'drive')}, "
            f"{plural(self.dreams, 'dream')} of each. The road is lost after {plural(self.lasting, 'step')} in a row "
            "off it, and the end is as long"
        )


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
    for drive in islice(drives, MAX_DRIVES * config.losses):
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
    for fold, rest in folds(len(drives), most=FOLDS):
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
        length = before + driven.after
        begun = {row: DreamSegment(drive, (drive.lost or 0) - before, length) for row, drive in lost.items()}
        kinds.append((f"{plural(before, 'step')} before", begun))
    longest = max(config.before) + driven.after
    found = {row: _find_calm_stretch(drive, longest, driven.opening) for row, drive in enumerate(drives)}
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


@dataclass(frozen=True)
class RareFrequency:
    """One quantity: the absolute value that a tenth of real steps exceeds, and the shares of steps that exceed it.

    The shares are by source: `reality` by the true state, `foreseen` by the probe on real steps predicted one step
    ahead, `dream` by the probe on dreamt steps.
    """

    quantity: str
    rare: float
    found: dict[str, Estimate]


@dataclass(frozen=True)
class LikenessReport:
    """Each quantity's shares, and of how many drives, dreams of each, and dreams of which temperature they are."""

    drives: int
    dreams: int
    temperature: float
    quantities: tuple[RareFrequency, ...]

    def table(self) -> Table:
        """As rows, and a text that describes them."""
        rows = [
            {"quantity": each.quantity, "rare": f"above {each.rare:.3g}"}
            | {WHERE[where]: str(share) for where, share in each.found.items()}
            for each in self.quantities
        ]
        return rows, (
            "shares of steps ± standard errors over drives: at these a quantity is larger than at nine of ten real "
            "steps. Measured by the truth, and by a linear probe on [z, h]. Dreams begin after each drive's opening "
            "and last as long"
        )


def compare_frequencies(
    drives: Sequence[DisturbedDrive], bundle: Bundle, controller: Controller, opening: int, dreams: int,
    temperature: float,
) -> LikenessReport:  # fmt: skip
    """Compare each drive, from its opening until it leaves the road, with dreams of the same length and disturbance.

    `UsageError` if fewer than two drives stay on the road for long enough.
    """
    begun = [each for drive in drives if (each := _dream_segment(drive, opening)) is not None]
    if len(begun) < 2:
        raise UsageError(f"dreams are compared with two drives at least that stay on the road for {SHORTEST} steps")
    dreamer = DriveDreamer(bundle, controller, temperature, dreams)
    if not (names := [name for name in begun[0].drive.truth if name != OFF]):
        raise UsageError("the world's true state has no quantity to compare dreams with")
    truths = [np.stack([each.drive.truth[name][each.steps] for name in names], axis=1) for each in begun]
    foreseen = [dreamer.predict_next(each.drive)[0][each.steps] for each in begun]
    rare = np.quantile(np.abs(np.concatenate(truths)), RARE, axis=0)
    shares: list[dict[str, Doubles]] = []
    for fold, rest in folds(len(begun), most=FOLDS):
        probe = LinearProbe.fit(*(np.concatenate([each[row] for row in rest]) for each in (foreseen, truths)))
        for row in fold:
            dreamt = _before_ends(dreamer.dream(begun[row], own=True)[0])
            if not len(dreamt):
                continue
            found = {"reality": truths[row], "foreseen": probe.predict(foreseen[row]), "dream": probe.predict(dreamt)}
            shares.append({where: (np.abs(values) > rare).mean(axis=0) for where, values in found.items()})
    if len(shares) < 2:
        raise UsageError("the dreams of all drives but one end as they begin: nothing can be measured on them")
    quantities = tuple(
        RareFrequency(name, float(rare[row]), {w: Estimate.of([each[w][row] for each in shares]) for w in shares[0]})
        for row, name in enumerate(names)
    )
    return LikenessReport(len(drives), dreams, temperature, quantities)


def _before_ends(features: Floats) -> Floats:
    """The steps `(steps, features)` of dreams `(dreams, steps, features)` before their ends.

    After its end a dream repeats its last state.
    """
    still = (np.diff(features, axis=1) == 0).all(axis=2)
    return np.asarray(features[:, 1:][~still])


def _dream_segment(drive: DisturbedDrive, opening: int) -> DreamSegment | None:
    """The part of a drive from its opening until it first leaves the road; `None` if that is too short."""
    off = np.flatnonzero(drive.truth.get(OFF, np.zeros(len(drive)))[opening:] > 0)
    length = int(off[0]) if len(off) else len(drive) - opening
    return DreamSegment(drive, opening, length) if length >= SHORTEST else None
