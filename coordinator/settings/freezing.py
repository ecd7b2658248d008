"""The settings that a new run freezes in its journal, made of its configuration and checked against its world."""

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import describe_bundle
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.artifacts.driving import FIRST_WORLD, Driving
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.artifacts.world_facts import EndRule
from dreamfleet.common.cli.key_values import parse_arguments
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.measures import check_dreamt
from dreamfleet.common.protocol.messages import MAX_OPTIONS, OWN_END_VERSION, TaskSpec
from dreamfleet.common.protocol.tasks import DREAM, GYM, describe_task, is_function_task, is_shipped
from dreamfleet.common.runs.records import EXTERNAL, RunSettings
from dreamfleet.common.runs.stages import Stage, stages_of
from dreamfleet.coordinator.settings.config import DEFAULT_HORIZON, NO_SUBSPACE, RunConfig, frozen_values
from dreamfleet.coordinator.settings.presets import check_preset_fits
from dreamfleet.coordinator.settings.stage_tables import check_schedule, split_first_stage

Scored = tuple[TaskSpec, ControllerShape, tuple[str, ...]]
"""What candidates are scored by: the task, the shape of a controller, and the packages of the fingerprint."""


def freeze(config: RunConfig, bundle: Bundle | None) -> RunSettings:
    """The settings to store in the journal; `config_values` is the inverse. `UsageError` for what fits nothing.

    They hold the bundle's hash, or without a bundle the task's description of itself.
    """
    config = _fill_in(config, bundle)
    spec, shape, packages = _without_bundle(config) if bundle is None else _with_bundle(config, bundle)
    if names := config.measures:
        if config.task == DREAM:
            check_dreamt(names)
        spec = replace(spec, measures=names)
    if config.loaded_subspace is not None:
        _check_subspace(config.loaded_subspace, spec, shape, bundle)
    derived = {
        "task": spec,
        "packages": packages,
        "controller": shape,
        "confirm_episodes": _confirm_episodes(config),
        "optimiser_options": tuple(filter(None, config.optimiser_options)),
        "archive": config.axes,
        "subspace": "" if config.loaded_subspace is None else config.loaded_subspace.sha256,
        "evaluate_every": 0 if config.optimiser == EXTERNAL else config.evaluate_every,
    }
    settings = RunSettings(**{**frozen_values(RunSettings, config), **derived})
    check_schedule(settings)
    for stage in stages_of(settings):
        with _naming_stage(stage.number if config.stages else None):
            replace(config, **stage.values)  # checks each value
            if stage.starts_new_search and not settings.is_external:
                _try_optimiser(settings, stage, config.loaded_subspace)
    return settings


def _fill_in(config: RunConfig, bundle: Bundle | None) -> RunConfig:
    """The configuration with its first stage's settings, and with its world's task and horizon where it names none."""
    named, stages = split_first_stage(config.stages)
    with _naming_stage(1 if stages != config.stages else None):
        config = replace(config, **named, stages=stages)
    if config.task is None and bundle is not None:
        config = replace(config, task=bundle.manifest.task)
    if config.task is not None and is_function_task(config.task):
        return replace(config, horizon=1)  # docs/reference/tasks.md
    if config.horizon is None:
        limit = DEFAULT_HORIZON if bundle is None else bundle.manifest.world.horizon
        return replace(config, horizon=min(limit, DEFAULT_HORIZON))
    return config


def _confirm_episodes(config: RunConfig) -> int:
    """0 where nothing is evaluated: there is nothing to choose among."""
    if not config.evaluate_every or config.optimiser == EXTERNAL:
        return 0
    return max(config.evaluation_episodes, 2) if config.confirm_episodes is None else config.confirm_episodes


def _spec(config: RunConfig, bundle: str, shape: ControllerShape | None, options: str, version: int) -> TaskSpec:
    values = frozen_values(TaskSpec, config)
    return TaskSpec(**values, bundle=bundle, controller=shape, options=options, version=version)


def _with_bundle(config: RunConfig, bundle: Bundle) -> Scored:
    _check_world(config, bundle)
    if config.environment or config.observation or config.normalise or config.task_options:
        raise UsageError(
            "--environment, --observation, --normalise and --task-options are of tasks without a world model"
        )
    if config.recorded:
        bundle.check_recorded()
    driving, facts = _driving(config, bundle), bundle.manifest.world
    shape = bundle.with_controllers(bundle.shape_of(config.features, config.units, driving), driving).controller_shape
    own_shape = None if shape == bundle.default_shape else shape
    end = config.end and EndRule.parse(config.end).text
    end = "" if end == facts.end.text else end  # so that it scores as a run that names none
    version = driving.version + (OWN_END_VERSION if end else 0)
    spec = replace(_spec(config, bundle.sha256, own_shape, driving.options, version), end=end)
    return spec, shape, facts.packages


def _check_world(config: RunConfig, bundle: Bundle) -> None:
    """`UsageError` for a world model that the task surely cannot use; other packages' tasks may use CarRacing's."""
    task, world = str(config.task), bundle.manifest.task
    check_preset_fits(config.preset, world, bundle.path.name)
    if task in (DREAM, world):
        return
    if world != FIRST_WORLD or is_shipped(task):
        without = "; or without a world model: --bundle none" if task.partition(":")[0] == GYM else ""
        raise UsageError(
            f"{bundle.path.name} is a world model of {world}, and not of {task}: name one of that with --bundle"
            f"{without}"
        )


def _driving(config: RunConfig, bundle: Bundle) -> Driving:
    given, preset = (
        parse_arguments("--variant", each, "pedals=one") for each in (config.variant, config.preset_variant)
    )
    values, world = preset | given, bundle.manifest.task
    driving = bundle.driving_of(json.dumps(values, sort_keys=True) if values else "")
    if not driving.is_default and config.task not in (world, DREAM):
        raise UsageError(f"task {config.task} has no variants: {world} has, and its dream")
    costs = [each for each in driving.option_texts if each not in driving.without_costs.option_texts]
    drives = config.driven > 0 or any(each.driven for each in config.stages)
    if costs and config.task == DREAM and not drives:
        cost = costs[0].partition("=")[0]
        remedy = "omit it from --variant" if cost in given else f"pass --variant {cost}=0 over the preset's"
        raise UsageError(f"{cost} needs candidates that drive in the world: a dream has no lap and no road; {remedy}")
    return driving


def _without_bundle(config: RunConfig) -> Scored:
    task = str(config.task)
    check_preset_fits(config.preset, task)
    given = {
        "--temperature": config.temperature is not None,
        "--collect-every": config.collect_every,
        "--variant": config.variant,
    }
    if named := " and ".join(flag for flag, is_given in given.items() if is_given):
        raise UsageError(f"{named}: only tasks with a world model take this; omit it for {task}")
    description = config.description or describe_task(task, config.description_options())
    options = description.options if config.task_options is None else config.task_options
    if config.units and not description.observations:
        raise UsageError(
            f"{task} observes nothing, so there is no controller: leave --controller and --hidden-units out"
        )
    shape = ControllerShape(description.observations, description.outputs, config.units)
    if len(options) > MAX_OPTIONS:
        raise UsageError(
            f"the options of {task} to freeze with the run have {len(options)} characters, {MAX_OPTIONS} at "
            "most: omit --normalise, or give smaller arguments"
        )
    check_normalisation(options, description.observations)
    return _spec(config, "", shape, options, description.version), shape, description.packages


def check_normalisation(options: str, observations: int) -> None:
    """`UsageError` if the normalisation in hand-written options does not fit so many observations."""
    try:
        normal = json.loads(options or "{}").get("normal")
        if normal is None:
            return
        mean, deviation = normal["mean"], normal["deviation"]
        whole = len(mean) == len(deviation) == observations and all(map(math.isfinite, (*mean, *deviation)))
        fits = whole and min(deviation) > 0
    except (TypeError, KeyError, ValueError, AttributeError, OverflowError, RecursionError):
        fits = False
    if not fits:
        raise UsageError(
            f"--task-options: normal must have a mean and a positive deviation of {plural(observations, 'number')}"
        )


def _check_subspace(subspace: Subspace, spec: TaskSpec, shape: ControllerShape, bundle: Bundle | None) -> None:
    """`UsageError` for a subspace of another world model, or of controllers with other inputs."""
    if bundle is None or subspace.bundle not in bundle.same_models:  # docs/reference/optimisers.md
        raise UsageError(
            f"--subspace (given, or the preset's) belongs to {describe_bundle(subspace.bundle)}, "
            f"the run uses {describe_bundle(spec.bundle)}: give its own --bundle, or --subspace {NO_SUBSPACE}"
        )
    if (inputs := subspace.weights.shape[1]) != shape.features:
        raise UsageError(
            f"--subspace fits controllers that see {plural(inputs, 'number')}, latent and hidden state alone, "
            f"and this run's see {shape.features}: omit --features and feedback=last, or pass --subspace {NO_SUBSPACE}"
        )


def _try_optimiser(settings: RunSettings, stage: Stage, subspace: Subspace | None) -> None:
    """Build the run's optimiser once, so that a search which it cannot do is refused before the run exists."""
    from dreamfleet.coordinator.optimisers.evolution import Evolution  # heavy: `--help` reads this module too

    evolution = Evolution.of(settings, stage, subspace, None)
    if settings.on_failure == "redraw":  # docs/how-to/unattended.md
        if stage.settings.racing:
            raise UsageError("--on-failure redraw cannot be combined with --racing: a late candidate has no first half")
        evolution.check_redraws()


@contextmanager
def _naming_stage(number: int | None) -> Iterator[None]:
    """Name the stage in an error; `None`: the run has no schedule."""
    try:
        yield
    except UsageError as error:
        raise error if number is None else UsageError(f"stage {number}: {error}") from error
