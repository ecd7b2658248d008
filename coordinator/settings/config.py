"""What a run is, when it stops, and where it is reached: the coordinator's configuration."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.car_racing_variants import CAR_RACING, Variant
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.cli.config import option
from dreamfleet.common.cli.presets import preset_help_text
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES
from dreamfleet.common.protocol.messages import MAX_OPTIONS, MAX_TEMPERATURE, MIN_TEMPERATURE, TaskSpec
from dreamfleet.common.protocol.tasks import GYM, check_task, describe_task, is_self_describing
from dreamfleet.common.runs.records import STAGE_FIELDS, RunSettings, StageSettings
from dreamfleet.common.runs.stages import Stage, stages_of
from dreamfleet.common.transport.network import parse_metrics_address
from dreamfleet.coordinator.settings.schedule import check_schedule, split_first_stage

DEFAULT_BUNDLE, NO_BUNDLE, NO_SUBSPACE = "tiny", "none", "none"
DREAM = "dream"


PYTHON_LITERALS = {"True": True, "False": False, "None": None}
LARGEST_SHARE = 0.9  # of the fleet's time that evaluations may have: the strategy needs some
LARGEST_STEP = 1e6  # first step size; parameters travel in single precision
# What a journal and a message can hold.
SETTING_BOUNDS = {
    "population": (2, 10**5), "episodes": (1, 10**4), "horizon": (1, 10**6), "patience": (0, 10**6),
    "seed": (0, 2**63 - 1), "evaluate_every": (0, 10**6), "evaluation_episodes": (1, 10**4),
    "collect_every": (0, 10**6), "collect_episodes": (1, 10**4), "hidden_units": (1, 10**5),
    "confirm_episodes": (0, 10**4),
}  # fmt: skip


@dataclass(frozen=True)
class RunConfig:
    """What is frozen with a run."""

    preset: str | None = option(None, preset_help_text("run"))
    task: str = option("car-racing", "what candidates are scored in; a worker must know it")
    bundle: str | None = option(
        None, "the frozen world model: a shipped name, a file, or none (default tiny; none for gym:ENVIRONMENT)"
    )
    environment: tuple[str, ...] = option((), "KEY=VALUE of what a gym:ENVIRONMENT is made with; values as in JSON")
    normalise: bool = option(False, "shift and scale what a gym:ENVIRONMENT shows, as it is when the run begins")
    task_options: str | None = option(None, "the task's own options as `runs show` prints them, instead of these two")
    variant: tuple[str, ...] = option(
        (),
        "NAME=VALUE of how car-racing is driven: actions=discrete, pedals=half or one, pedal_shift=, decide_every=, "
        "feedback=last, in its dream too, and time_cost=, offroad_cost= (docs/tasks.md)",
    )
    controller: Literal["linear", "hidden"] = option("linear", "a linear map, or one with a layer of tanh units")
    hidden_units: int = option(8, "units of a hidden controller's layer")
    features: Literal["zh", "z"] = option("zh", "what the controller sees: latent and hidden state, or latent alone")
    population: int = option(32, "candidates a generation")
    episodes: int = option(2, "episodes a candidate, on the same fresh seeds for all")
    sigma0: float = option(0.1, "first step size")
    optimiser: str = option("cma", "what asks for candidates: cma, cmaes-lra, cmaes-sep, or yours as module:attribute")
    optimiser_options: tuple[str, ...] = option((), "the optimiser's own options, each as name=value")
    covariance: Literal["diagonal", "full"] = option("diagonal", "the model of CMA-ES; an option of cma")
    subspace: str | None = option(
        None,
        "a file of `dreamfleet subspace`, or one that ships: the search changes what controllers make of these few "
        "features alone, from where it begins; none: everything",
    )
    racing: bool = option(False, "let only the better half of the candidates drive the second half of the episodes")
    horizon: int = option(1000, "steps of a scored episode at most")
    patience: int = option(0, "cut a scored episode after so many steps without reward; 0: never")
    temperature: float | None = option(None, "of a dream's sampling; above 1 it is harder, and harder to exploit")
    recorded: float = option(
        0.0,
        "share of the dreams, 0 to 1, that begins where recorded drives were, with what the model remembered there; "
        "the bundle must hold such states",
    )
    driven: float = option(
        0.0,
        "share of a candidate's episodes, 0 to 1, that is driven in the world that the others dream of; 1: all, as in "
        "a schedule whose first stage dreams",
    )
    seed: int = option(1, "makes the run: population and training seeds follow from it")
    evaluate_every: int = option(25, "drive the mean in reality every so many generations; 0: never")
    evaluation_episodes: int = option(100, "whole episodes of an evaluation, on validation seeds")
    confirm_episodes: int | None = option(
        None,
        "confirm what is reported as the run ends, after its limits: the best evaluated means drive about twice as "
        "many seeds in rounds, then the one that is left so many fresh ones, which give its score (default as many "
        "as of an evaluation, 2 at least); 0: never",
    )
    collect_every: int = option(0, "keep rollouts of the mean for training, every so many generations; 0: never")
    collect_episodes: int = option(8, "drives that are kept each time, on training seeds")
    schedule: str | None = option(
        None,
        "a TOML file of stages, each a [[stage]] with its end (generations, steps, score) and its own horizon, "
        "patience, episodes, population, sigma0 and racing (docs/operations.md); none: no stages",
    )
    preset_variant: tuple[str, ...] = ()  # how the preset drives, where nothing else says it by name
    stages: tuple[StageSettings, ...] = ()  # what the schedule, or the configuration file, holds
    loaded_subspace: Subspace | None = None  # what that file holds

    def __post_init__(self) -> None:
        for name, (least, most) in SETTING_BOUNDS.items():
            flag, value = f"--{name.replace('_', '-')}", getattr(self, name)
            if value is None:
                continue
            if value < least:
                raise UsageError(f"{flag} must be at least {least}, not {value}")
            if value > most:
                raise UsageError(f"{flag} must be at most {most}, not {value}")
        if self.confirm_episodes == 1:
            raise UsageError("--confirm-episodes must be 0 or at least 2: one episode has no standard error")
        check_task(self.task)
        if self.racing and self.episodes < 2:
            raise UsageError("--racing needs at least 2 episodes: there is no second half of one")
        if not 0 < self.sigma0 <= LARGEST_STEP:
            raise UsageError(f"--sigma0 must be a positive number of at most {LARGEST_STEP:g}, not {self.sigma0}")
        if self.temperature is not None and not MIN_TEMPERATURE <= self.temperature <= MAX_TEMPERATURE:
            raise UsageError(
                f"--temperature must be from {MIN_TEMPERATURE:g} to {MAX_TEMPERATURE:g}, not {self.temperature}"
            )
        if not 0 <= self.recorded <= 1:
            raise UsageError(f"--recorded must be from 0 to 1, not {self.recorded}")
        if self.recorded and self.task != DREAM:
            raise UsageError(f"--recorded is of task {DREAM}, not of {self.task}: leave it out, or say 0")
        self._check_driven()

    def _check_driven(self) -> None:
        if not 0 <= self.driven <= 1:
            raise UsageError(f"--driven must be from 0 to 1, not {self.driven}")
        if self.driven and self.task != DREAM:
            raise UsageError(f"--driven is of task {DREAM}, not of {self.task}: leave it out, or say 0")
        if not 0 < self.driven < 1:
            return
        if round(self.driven * self.episodes) in (0, self.episodes):
            raise UsageError(
                f"--driven {self.driven:g} of {self.episodes} episodes is none of them, or all: give another share, or "
                "more --episodes"
            )
        if self.racing:
            raise UsageError(
                "--racing compares all candidates by the first half of their episodes, and of a mixture that would be "
                "the driven ones: leave it out, or say --driven 0 or 1"
            )

    @property
    def needs_no_bundle(self) -> bool:
        """Whether candidates are scored without a world model."""
        return self.bundle == NO_BUNDLE or (self.bundle is None and is_self_describing(self.task))

    def settings(self, bundle: Bundle | None) -> RunSettings:
        """What the journal keeps: the bundle by its hash, or what a task that needs none says of itself."""
        named, stages = split_first_stage(self.stages)
        if stages != self.stages:
            with _naming_stage(1):
                own = replace(self, **named, stages=stages)
            return own.settings(bundle)
        spec, shape, packages = self._resolve_without_bundle() if bundle is None else self._resolve_with_bundle(bundle)
        if self.loaded_subspace is not None:
            _check_subspace(self.loaded_subspace, spec, shape)
        settings = RunSettings(
            task=spec,
            packages=packages,
            controller=shape,
            population=self.population,
            episodes=self.episodes,
            sigma0=self.sigma0,
            covariance=self.covariance,
            seed=self.seed,
            evaluate_every=self.evaluate_every,
            evaluation_episodes=self.evaluation_episodes,
            racing=self.racing,
            features=self.features,
            confirm_episodes=self._confirm_episodes,
            collect_every=self.collect_every,
            collect_episodes=self.collect_episodes,
            driven=self.driven,
            optimiser=self.optimiser,
            optimiser_options=tuple(filter(None, self.optimiser_options)),
            subspace="" if self.loaded_subspace is None else self.loaded_subspace.sha256,
            stages=self.stages,
        )
        check_schedule(settings)
        for stage in stages_of(settings):
            with _naming_stage(stage.number if self.stages else None):
                replace(self, **{name: getattr(stage, name) for name in STAGE_FIELDS})  # which looks at each value
                if stage.starts_new_search:
                    _try_optimiser(settings, stage, self.loaded_subspace)
        return settings

    @property
    def _confirm_episodes(self) -> int:
        """None where nothing is evaluated: there is nothing to choose among."""
        if not self.evaluate_every:
            return 0
        return max(self.evaluation_episodes, 2) if self.confirm_episodes is None else self.confirm_episodes

    @property
    def _hidden(self) -> int:
        return self.hidden_units if self.controller == "hidden" else 0

    def _resolve_with_bundle(self, bundle: Bundle) -> tuple[TaskSpec, ControllerShape, tuple[str, ...]]:
        if self.task.partition(":")[0] == GYM:
            raise UsageError(f"{self.task} is scored without a world model: leave --bundle out, or give --bundle none")
        if self.environment or self.normalise or self.task_options:
            raise UsageError("--environment, --normalise and --task-options are of tasks without a world model")
        if self.recorded:
            bundle.check_recorded()
        variant = self._variant()
        shape = bundle.with_controllers(bundle.shape_of(self.features, self._hidden, variant), variant).controller_shape
        named = None if shape == bundle.default_shape else shape
        spec = TaskSpec(
            self.task, bundle.sha256, self.horizon, self.patience, named, self.temperature, variant.options,
            variant.version, self.recorded,
        )  # fmt: skip
        return spec, shape, NUMERIC_PACKAGES

    def _variant(self) -> Variant:
        """How the run's controllers drive."""
        given, preset = (_arguments("--variant", each, "pedals=one") for each in (self.variant, self.preset_variant))
        variant = Variant.from_values(preset | given)
        if not variant.is_default and self.task not in (CAR_RACING, DREAM):
            raise UsageError(f"task {self.task} has no variants: {CAR_RACING} has, and its dream")
        if (variant.time_cost or variant.offroad_cost) and self.task == DREAM:
            cost = "time_cost" if variant.time_cost else "offroad_cost"
            raise UsageError(
                f"{cost} is of candidates that drive: a dream knows of no lap and no road; name --variant without it"
            )
        return variant

    def _resolve_without_bundle(self) -> tuple[TaskSpec, ControllerShape, tuple[str, ...]]:
        if self.temperature is not None or self.collect_every or self.variant:
            raise UsageError("--temperature, --collect-every and --variant are of tasks with a world model")
        told = describe_task(self.task, self._options())
        options = told.options if self.task_options is None else self.task_options
        shape = ControllerShape(told.observations, told.outputs, self._hidden)
        if len(options) > MAX_OPTIONS:
            raise UsageError(
                f"what the run would freeze of {self.task} takes {len(options)} characters, {MAX_OPTIONS} at most: "
                "leave --normalise out, or give smaller arguments"
            )
        _check_normalisation(options, told.observations)
        spec = TaskSpec(self.task, "", self.horizon, self.patience, shape, options=options, version=told.version)
        return spec, shape, told.packages

    def _options(self) -> dict[str, Any]:
        """What the task is asked to describe itself under."""
        if self.task_options is not None:
            try:
                frozen = json.loads(self.task_options or "{}")
                return {"environment": dict(frozen.get("environment", {}))}
            except (ValueError, AttributeError, TypeError, RecursionError) as error:
                raise UsageError(f"--task-options must be a JSON object, not {self.task_options!r}") from error
        arguments = _arguments("--environment", self.environment, "continuous=true")
        options: dict[str, Any] = {"environment": arguments} if arguments else {}
        return options | ({"normalise": True, "seed": self.seed} if self.normalise else {})


def _check_normalisation(options: str, observations: int) -> None:
    """`UsageError` if a normalisation that was given by hand cannot be one of so many observations."""
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
        raise UsageError(f"--task-options: normal must have a mean and a positive deviation of {observations} numbers")


def _arguments(flag: str, texts: Sequence[str], example: str) -> dict[str, Any]:
    """The values of a flag's KEY=VALUE texts by their keys; `example` is one of them."""
    arguments = [_argument(flag, text, example) for text in texts]
    if len(dict(arguments)) < len(arguments):
        raise UsageError(f"{flag}: a KEY stands there twice")
    return dict(arguments)


def _argument(flag: str, text: str, example: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not (equals and name.isidentifier()):
        raise UsageError(f"{flag} {text!r}: write KEY=VALUE, such as {example}")
    if value in PYTHON_LITERALS:  # as people who know gymnasium write it
        return name, PYTHON_LITERALS[value]
    try:
        return name, json.loads(value)
    except (ValueError, RecursionError):
        return name, value


@contextmanager
def _naming_stage(number: int | None) -> Iterator[None]:
    """Say of which stage an error is; `None`: of no schedule's."""
    try:
        yield
    except UsageError as error:
        raise error if number is None else UsageError(f"stage {number}: {error}") from error


def _check_subspace(subspace: Subspace, spec: TaskSpec, shape: ControllerShape) -> None:
    """`UsageError` for one of another world model, or of controllers that see something else."""
    if subspace.bundle != spec.bundle:
        own = f"world model {spec.bundle[:12]}" if spec.bundle else "a task without a world model"
        raise UsageError(
            f"--subspace (given, or the preset's) is of world model {subspace.bundle[:12]}, and the run is on {own}: "
            f"give its own --bundle, or --subspace {NO_SUBSPACE}"
        )
    if (inputs := subspace.weights.shape[1]) != shape.features:
        raise UsageError(
            f"--subspace is of controllers that see {inputs} numbers, latent and hidden state alone, and this run's "
            f"see {shape.features}: leave --features and feedback=last out, or say --subspace {NO_SUBSPACE}"
        )


def _try_optimiser(settings: RunSettings, stage: Stage, subspace: Subspace | None) -> None:
    """Build the run's optimiser once, so that what it cannot do is said before there is a run."""
    from dreamfleet.coordinator.optimisers.evolution import (  # heavy: `--help` reads this module too
        Evolution,
        EvolutionConfig,
    )

    Evolution(EvolutionConfig.of(settings, stage, subspace))


def config_values(run: RunSettings, bundle: Path) -> dict[str, Any]:
    """The settings of a run as they would be configured; `bundle` is where its copy of the world model lies."""
    frozen = {each.name: getattr(run, each.name) for each in fields(RunConfig) if hasattr(run, each.name)}
    del frozen["subspace"]  # its hash there, where a file is named here
    spec, hidden = run.task, run.controller.hidden
    frozen |= {"controller": "hidden", "hidden_units": hidden} if hidden else {"controller": "linear"}
    frozen |= {name: getattr(spec, name) for name in ("task", "horizon", "patience", "temperature", "recorded")}
    if not spec.bundle:
        return {**frozen, "bundle": NO_BUNDLE, "task_options": spec.options}
    return {**frozen, "bundle": str(bundle), "variant": Variant.from_json(spec.options).option_texts}


@dataclass(frozen=True)
class LimitsConfig:
    """When a run ends: at the first limit reached; all are checked as a generation ends. 0: no such limit."""

    generations: int = option(0, "stop after so many generations")
    steps: int = option(0, "stop after so many environment steps")
    minutes: float = option(
        0.0, "stop after so many minutes of generations; what is evaluated last, and confirmed, comes on top"
    )
    target: float | None = option(None, "stop when an evaluated mean reaches this score")
    parted: int = option(0, "stop when so many evaluations in a row fell clearly behind the best one before them")

    def __post_init__(self) -> None:
        for name in ("generations", "steps", "minutes", "parted"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise UsageError(f"--{name} must not be negative")
        if self.target is not None and not math.isfinite(self.target):
            raise UsageError(f"--target must be a number, not {self.target}")


@dataclass(frozen=True)
class NetworkConfig:
    """Where the coordinator is reached, and how it treats its workers."""

    listen: tuple[str, ...] = option((), "listen here (default tcp/127.0.0.1:7447, unless --connect is given)")
    connect: tuple[str, ...] = option((), "connect to these stand-alone routers, as well where --listen is given")
    beat: float = option(1.0, "seconds between a worker's beats")
    evaluation_share: float = option(0.25, "of a busy fleet's time that evaluations get, 0 to 0.9; 0: only idle slots")
    strict: bool = option(
        False,
        "take results only of hosts that compute the same bits as the first one that scored, so that the run ends with "
        "the same bits whoever is killed",
    )
    metrics_port: str = option(
        "", "answer Prometheus under /metrics at this port of 127.0.0.1, or at HOST:PORT; anybody there may read it"
    )
    insecure: bool = option(
        False, "listen beyond this host without a join file: anyone who reaches the port owns the run, may read, forge "
        "and stop everything"
    )  # fmt: skip

    def __post_init__(self) -> None:
        if self.metrics_port:
            parse_metrics_address(self.metrics_port)
        if not 0.05 <= self.beat <= 60:
            raise UsageError(f"--beat must be from 0.05 to 60 seconds, not {self.beat}")
        if not 0 <= self.evaluation_share <= LARGEST_SHARE:
            raise UsageError(f"--evaluation-share must be from 0 to {LARGEST_SHARE}, not {self.evaluation_share}")
