"""Refit a controller to another world model: imitate its choices on recorded drives by least squares.

Weights on [z, h] do not fit another encoder's z, nor an MDN-RNN's h after further training. So both models follow the
same drives, and ridge regression fits the first layer on the new model's [z, h] to the values, before tanh, that the
old first layer gives on its own model's. Later layers stay as they are. This is behavioural cloning (Pomerleau 1991)
of the controller, on drives that other drivers may have driven. Pages: dreams.md, train.md.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import one_hot
from dreamfleet.common.artifacts.bundle import DREAM_GRAPH, ENCODER, Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import ControllerError, UsageError
from dreamfleet.common.printable import plural
from dreamfleet.worker.addons.refit.drive_regression import (
    FeatureExtractor,
    LeastSquaresSums,
    SplitSums,
    check_drives,
    load_in_batches,
)
from dreamfleet.worker.scoring.rollout import DataWorld
from dreamfleet.worker.tasks.registry import task_of
from dreamfleet.worker.training.data.drive_steps import on_road_mask

RIDGE = 0.01  # relative to a feature's mean square, which is below 1 for h and about 1 for informative latents
TANH_BOUND = 2.5  # tanh is 0.987 there; larger values change the action little
BOUND_MARGIN = 0.3  # how far a value may lie beyond its action's bound, so that a search can still move it back

Doubles = NDArray[np.float64]


@dataclass(frozen=True)
class RefitResult:
    """The fitted controller, the drives and steps it was fitted on, and R² per first-layer value on held-out ones."""

    controller: Controller
    drives: int
    steps: int
    r_squared: tuple[float, ...]


def refit(
    controller: Controller, own: Bundle, bundle: Bundle, paths: Sequence[Path], on_progress: Callable[[int], None]
) -> RefitResult:
    """Refit a controller of the world model `own` to `bundle`; `on_progress` gets the number of drives processed.

    The parameters stay the same if both models have the same encoder and dream graph.

    `ControllerError` if the two worlds or their pictures differ. `DatasetError` for damaged drives or other pictures or
    actions. `UsageError` if the controller sees its own last choices, or if no drive stays on its road.
    """
    if all(own.read(part) == bundle.read(part) for part in (ENCODER, DREAM_GRAPH)):
        return RefitResult(replace(controller, bundle=bundle.sha256), 0, 0, ())
    _check_compatible(controller, own, bundle, paths)
    driving = bundle.driving_of(controller.options)
    features = "zh" if controller.shape.features > own.manifest.latent else "z"
    shape = bundle.shape_of(features, controller.shape.hidden, driving)
    fitted, lost_after = bundle.with_options(shape, controller.options), task_of(own).world.lost_after
    old, new = FeatureExtractor(own.for_controller(controller)), FeatureExtractor(fitted)
    lowest, highest = output_bounds(controller, own)
    same_encoder = own.read(ENCODER) == bundle.read(ENCODER)
    (weights, biases), *above = controller.shape.unpack(controller.parameters)
    split = SplitSums()
    for first, drives in load_in_batches(paths, own.manifest.actions):
        latent = old.encode_drives(drives)
        before = old.features(drives, latent)
        after = new.features(drives, latent if same_encoder else new.encode_drives(drives))
        for row, drive in enumerate(drives):
            on = on_road_mask(drive.reward, lost_after)
            wanted = before[row, : len(on)][on].astype(np.float64) @ weights.T.astype(np.float64) + biases
            sums = LeastSquaresSums.of(after[row, : len(on)][on], np.clip(wanted, lowest, highest))
            split.add(first + row, sums)
        on_progress(first + len(drives))
    fit, held_out = split.fit, split.held_out
    if not fit.steps:
        few = plural(len(paths), "drive")
        raise UsageError(f"none of the {few} stays on its road: there is nothing to fit a controller to")
    r_squared = held_out.r_squared(fit.solve(RIDGE)) if held_out.steps else np.full(len(biases), np.nan)
    whole = fit + held_out
    solved = whole.solve(RIDGE)
    parts = [solved[:-1].T, solved[-1], *(part for layer in above for part in layer)]
    parameters = np.concatenate([part.ravel() for part in parts]).astype(np.float32)
    moved = replace(controller, shape=fitted.controller_shape, parameters=parameters, bundle=bundle.sha256,
                    provenance={"refitted_from": controller.sha256, "of_world_model": controller.bundle})  # fmt: skip
    return RefitResult(moved, len(paths), whole.steps, tuple(float(each) for each in r_squared))


def output_bounds(controller: Controller, own: Bundle) -> tuple[Doubles, Doubles]:
    """The lower and upper bounds `(outputs,)` to which the first layer's target values are clipped.

    An action that is clipped, such as a brake below 0, does not depend on how far the value lies beyond the bound.
    Values of discrete choices are compared with each other, and linear actions are the values, so neither are clipped.
    """
    outputs = controller.shape.layers[0][0]
    lowest, highest = np.full(outputs, -TANH_BOUND), np.full(outputs, TANH_BOUND)
    actions = own.driving_of(controller.options).controls
    if (actions.sizes or not actions.squashed) and not controller.shape.hidden:
        return lowest * np.inf, highest * np.inf
    if controller.shape.hidden or actions.output_indices:
        return lowest, highest
    ranges = zip(actions.scale, actions.shift, actions.low, actions.high, strict=True)
    for output, (scale, shift, low, high) in enumerate(ranges):
        for bound, beyond in ((low, -1), (high, 1)):
            squashed = (bound - shift) / scale
            if abs(squashed) >= 1:
                continue  # tanh does not reach it
            rest = math.atanh(squashed)
            if beyond * scale < 0:
                lowest[output] = max(lowest[output], rest - BOUND_MARGIN)
            else:
                highest[output] = min(highest[output], rest + BOUND_MARGIN)
    return lowest, highest


def output_names(controller: Controller, own: Bundle) -> tuple[str, ...]:
    """Names for the outputs of a controller's first layer: the actions' names if they correspond one to one."""
    names, count = task_of(own).world.action_names, controller.shape.layers[0][0]
    actions = own.driving_of(controller.options).controls
    is_named = not actions.output_indices and actions.choices in ((), one_hot(actions.actions).choices)
    if is_named and not controller.shape.hidden and len(names) == count:
        return names
    return tuple(f"output {number + 1}" for number in range(count))


def _check_compatible(controller: Controller, own: Bundle, bundle: Bundle, paths: Sequence[Path]) -> None:
    (world, seen), (other, shown) = ((DataWorld.of(each), each.manifest.preprocessing) for each in (own, bundle))
    if (world, seen) != (other, shown):
        raise ControllerError(
            f"the controller sees {seen!r} of {world}, and {bundle.manifest.name} {shown!r} of {other}: no drive shows "
            "both"
        )
    if own.driving_of(controller.options).extra_features:
        raise UsageError("it looks at its own last choices, which no recorded drive holds: it cannot be refitted")
    check_drives(paths, own)
