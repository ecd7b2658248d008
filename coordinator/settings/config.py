"""What a run is: its settings, which it freezes in its journal.

Each setting is one field. The bounds are in its annotation; `frozen_option` names the record that stores it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.artifacts.driving import FIRST_WORLD, Driving, Variant
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.artifacts.world_facts import EndRule
from dreamfleet.common.cli.config import option
from dreamfleet.common.cli.key_values import parse_arguments
from dreamfleet.common.cli.presets import preset_help_text
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.measures import NO_ARCHIVE, check_dreamt, parse_axes
from dreamfleet.common.protocol.messages import (
    MAX_OPTIONS,
    OWN_END_VERSION,
    Horizon,
    Patience,
    Share,
    TaskSpec,
    Temperature,
)
from dreamfleet.common.protocol.tasks import (
    DREAM,
    GYM,
    Description,
    check_task,
    describe_task,
    is_function_task,
    is_self_describing,
    is_shipped,
)
from dreamfleet.common.runs.records import (
    EXTERNAL,
    STAGE_FIELDS,
    ConfirmationEpisodes,
    EpisodesPerCandidate,
    OnFailure,
    PopulationSize,
    RunSettings,
    StageSettings,
)
from dreamfleet.common.runs.stages import stages_of
from dreamfleet.common.schema.validation import Count
from dreamfleet.coordinator.settings.bounds import check_bounds
from dreamfleet.coordinator.settings.presets import check_preset_fits
from dreamfleet.coordinator.settings.run_checks import check_subspace, try_optimiser
from dreamfleet.coordinator.settings.schedule import check_schedule, split_first_stage
from dreamfleet.coordinator.settings.task_options import (
    check_normalisation,
    parse_described,
)

DEFAULT_BUNDLE, NO_BUNDLE = "tiny", "none"
DEFAULT_HORIZON = 1000  # steps
LARGEST_STEP = 1e6  # of sigma0: parameters travel in single precision
Interval = Annotated[int, Meta(ge=0, le=10**6)]  # generations; 0: never


def frozen_option(record: type, default: Any, text: str) -> Any:
    """An option that a run freezes under the same name: in `RunSettings`, or in `TaskSpec` where workers need it."""
    return field(default=default, metadata={"help": text, "record": record})


@dataclass(frozen=True)
class RunConfig:
    """What is frozen with a run."""

    preset: str | None = option(None, preset_help_text("run"))
    task: str | None = frozen_option(
        TaskSpec, None, "what candidates are scored in; a worker must know it (default the world of the bundle)"
    )
    bundle: str | None = option(
        None,
        "the frozen world model: a shipped name, a file, or none (default tiny; none for gym:ENVIRONMENT and other "
        "tasks that need none)",
    )
    environment: tuple[str, ...] = option(
        (), "KEY=VALUE arguments of gym:ENVIRONMENT or function:MODULE:NAME; values as in JSON"
    )
    observation: tuple[str, ...] = option(
        (), "keys of the Dict that gym:ENVIRONMENT observes which the controller sees (default all that are numbers)"
    )
    normalise: bool = option(
        False, "shift and scale the observations of gym:ENVIRONMENT by their statistics when the run begins"
    )
    task_options: str | None = option(
        None,
        "the task's own options as `runs show` prints them, instead of --environment, --observation and --normalise",
    )
    variant: tuple[str, ...] = option(
        (),
        f"NAME=VALUE of how controllers of a world model drive: decide_every=, feedback=last; and in {FIRST_WORLD} "
        "actions=linear or discrete, pedals=half or one, pedal_shift=, in its dream too, time_cost=, offroad_cost= "
        "(docs/reference/tasks.md)",
    )
    controller: Literal["linear", "hidden"] = option("linear", "a linear map, or one with a layer of tanh units")
    hidden_units: Annotated[int, Meta(ge=1, le=10**5)] = option(8, "units of a hidden controller's layer")
    features: Literal["zh", "z"] = frozen_option(
        RunSettings, "zh", "what the controller sees: latent and hidden state, or latent alone"
    )
    population: PopulationSize = frozen_option(RunSettings, 32, "candidates a generation")
    episodes: EpisodesPerCandidate = frozen_option(
        RunSettings, 2, "episodes a candidate, on the same fresh seeds for all"
    )
    sigma0: float = frozen_option(RunSettings, 0.1, "first step size")
    optimiser: str = frozen_option(
        RunSettings,
        "cma",
        "what proposes candidates: cma, cmaes-lra, cmaes-sep, openes, pepg, snes, xnes, of an archive cma-me and "
        "map-elites, or yours as module:attribute; external: a search elsewhere submits them, over Zenoh or HTTP",
    )
    optimiser_options: tuple[str, ...] = frozen_option(
        RunSettings, (), "the optimiser's own options, each as name=value"
    )
    archive: tuple[str, ...] = frozen_option(
        RunSettings,
        (),
        "keep the best candidate of each kind of behaviour: axes, each MEASURE=LOW:HIGH:CELLS, such as steps=0:500:20; "
        "cma-me and map-elites need it; none: no archive (docs/how-to/quality-diversity.md)",
    )
    covariance: Literal["diagonal", "full"] = frozen_option(
        RunSettings, "diagonal", "the model of CMA-ES; an option of cma"
    )
    subspace: str | None = option(
        None,
        "search only in the features of this subspace, from the run's first mean: a file of `dreamfleet lab subspace`, "
        "or a shipped name; none: all parameters",
    )
    racing: bool = frozen_option(
        RunSettings, False, "let only the better half of the candidates drive the second half of the episodes"
    )
    horizon: Horizon | None = frozen_option(
        TaskSpec,
        None,
        f"steps of a scored episode at most (default {DEFAULT_HORIZON}, or the limit of the bundle's world if lower)",
    )
    patience: Patience = frozen_option(TaskSpec, 0, "cut a scored episode after so many steps without reward; 0: never")
    temperature: Temperature | None = frozen_option(
        TaskSpec, None, "temperature of a dream's sampling; above 1 it is harder, and harder to exploit"
    )
    recorded: Share = frozen_option(
        TaskSpec,
        0.0,
        "share of the dreams, 0 to 1, that begins where recorded drives were, with what the model remembered there; "
        "the bundle must hold such states",
    )
    end: str = frozen_option(
        TaskSpec,
        "",
        "when a dream ends: drawn, at random with the predicted probability under its temperature, or above a "
        "probability from 0 to 1 (default the bundle's own rule)",
    )
    driven: Share = frozen_option(
        RunSettings,
        0.0,
        "share of a candidate's episodes, 0 to 1, that is driven in the world that the others dream of; 1: all, as in "
        "a schedule whose first stage dreams",
    )
    on_failure: OnFailure = frozen_option(
        RunSettings, "worst", "a candidate whose episode fails in two independent attempts: ranks last (worst), is "
        "drawn anew (redraw), or pauses the run (pause)",
    )  # fmt: skip
    seed: Count = frozen_option(RunSettings, 1, "makes the run: population and training seeds follow from it")
    evaluate_every: Interval = frozen_option(
        RunSettings, 25, "drive the mean in reality every so many generations; 0: never"
    )
    evaluation_episodes: EpisodesPerCandidate = frozen_option(
        RunSettings, 100, "whole episodes of an evaluation, on validation seeds"
    )
    confirm_episodes: ConfirmationEpisodes | None = frozen_option(
        RunSettings,
        None,
        "episodes on fresh seeds that confirm what is reported, once a limit is reached (default as many as of an "
        "evaluation, 2 at least); 0: never. Before, the best evaluated means have about twice as many in rounds",
    )
    collect_every: Interval = frozen_option(
        RunSettings, 0, "keep rollouts of the mean for training, every so many generations; 0: never"
    )
    collect_episodes: EpisodesPerCandidate = frozen_option(
        RunSettings, 8, "drives that are kept each time, on training seeds"
    )
    schedule: str | None = option(
        None,
        "a TOML file of stages, each a [[stage]] with its end (generations, steps, score) and its own horizon, "
        "patience, episodes, population, sigma0 and racing (docs/how-to/stages.md); none: no stages",
    )
    preset_variant: tuple[str, ...] = ()  # the preset's variant, which `variant` overrides name by name
    stages: tuple[StageSettings, ...] = field(default=(), metadata={"record": RunSettings})  # read from the schedule
    loaded_subspace: Subspace | None = None  # read from the file that `subspace` names
    description: Description | None = None  # of a task without bundle, where the check of the task gave it

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.confirm_episodes == 1:
            raise UsageError("--confirm-episodes must be 0 or at least 2: one episode has no standard error")
        if self.task is not None:
            check_task(self.task)
        elif self.bundle == NO_BUNDLE:
            raise UsageError(f"--bundle {NO_BUNDLE}: name what candidates are scored in with --task")
        if self.racing and self.episodes < 2:
            raise UsageError("--racing needs at least 2 episodes, as one has no second half")
        if not 0 < self.sigma0 <= LARGEST_STEP:
            raise UsageError(f"--sigma0 must be a positive number of at most {LARGEST_STEP:g}, not {self.sigma0}")
        for name, nothing in {"recorded": "0", "driven": "0", "end": "''"}.items():
            if getattr(self, name) and self.task != DREAM:
                other = self.task or (default_world() if self.bundle is None else "the world that it dreams of")
                raise UsageError(f"--{name} needs task {DREAM}, not {other}: omit it, or pass {nothing}")
        if self.end:
            EndRule.parse(self.end)
        if 0 < self.driven < 1:
            self._check_driven()
        if self.optimiser == EXTERNAL:
            self._check_external()

    def _check_external(self) -> None:
        """`UsageError` for what only a run's own search can have."""
        given = {
            "--racing": self.racing,
            "--driven": self.driven,
            "--schedule": self.stages,
            "--subspace": self.loaded_subspace is not None,
            "--collect-every": self.collect_every,
            "--archive": any(each != NO_ARCHIVE for each in self.archive),
            "--covariance": self.covariance != "diagonal",
            "--optimiser-options": any(self.optimiser_options),
            "--on-failure": self.on_failure != "worst",
            "--evaluate-every": self.evaluate_every not in (0, RunConfig.evaluate_every),
        }
        if named := [flag for flag, is_given in given.items() if is_given]:
            raise UsageError(
                f"{' and '.join(named)}: a run with --optimiser {EXTERNAL} has no search of its own, so leave this out"
            )

    def _check_driven(self) -> None:
        """`UsageError` for a mixture of dreams and drives that no candidate can have."""
        if round(self.driven * self.episodes) in (0, self.episodes):
            raise UsageError(
                f"--driven {self.driven:g} of {plural(self.episodes, 'episode')} is none of them, or all: give "
                "another share, or "
                "more --episodes"
            )
        if self.racing:
            raise UsageError(
                "--racing compares all candidates by the first half of their episodes, and of a mixture that would be "
                "the driven ones: omit it, or pass --driven 0 or 1"
            )

    @property
    def needs_no_bundle(self) -> bool:
        """Whether candidates are scored without a world model."""
        if self.bundle is not None or self.task in (None, DREAM):
            return self.bundle == NO_BUNDLE
        return self.task != default_world() and is_self_describing(self.task)

    def settings(self, bundle: Bundle | None) -> RunSettings:
        """The settings to store in the journal; `config_values` is the inverse.

        They hold the bundle's hash, or without a bundle the task's description of itself.
        """
        named, stages = split_first_stage(self.stages)
        if stages != self.stages:
            with _naming_stage(1):
                own = replace(self, **named, stages=stages)
            return own.settings(bundle)
        if self.task is None and bundle is not None:
            return replace(self, task=bundle.manifest.task).settings(bundle)
        if self.task is not None and is_function_task(self.task) and self.horizon != 1:
            return replace(self, horizon=1).settings(bundle)
        if self.horizon is None:
            limit = DEFAULT_HORIZON if bundle is None else bundle.manifest.facts.horizon
            return replace(self, horizon=min(limit, DEFAULT_HORIZON)).settings(bundle)
        spec, shape, packages = self._resolve_without_bundle() if bundle is None else self._resolve_with_bundle(bundle)
        if names := self.measures:
            if self.task == DREAM:
                check_dreamt(names)
            spec = replace(spec, measures=names)
        if self.loaded_subspace is not None:
            check_subspace(self.loaded_subspace, spec, shape, bundle)
        derived = {
            "task": spec,
            "packages": packages,
            "controller": shape,
            "confirm_episodes": self._confirm_episodes,
            "optimiser_options": tuple(filter(None, self.optimiser_options)),
            "archive": self._archive,
            "subspace": "" if self.loaded_subspace is None else self.loaded_subspace.sha256,
            "evaluate_every": 0 if self.optimiser == EXTERNAL else self.evaluate_every,
        }
        settings = RunSettings(**{**frozen_values(RunSettings, self), **derived})
        check_schedule(settings)
        for stage in stages_of(settings):
            with _naming_stage(stage.number if self.stages else None):
                replace(self, **{name: getattr(stage, name) for name in STAGE_FIELDS})  # checks each value
                if stage.starts_new_search and not settings.is_external:
                    try_optimiser(settings, stage, self.loaded_subspace)
        return settings

    @property
    def _confirm_episodes(self) -> int:
        """0 where nothing is evaluated: there is nothing to choose among."""
        if not self.evaluate_every or self.optimiser == EXTERNAL:
            return 0
        return max(self.evaluation_episodes, 2) if self.confirm_episodes is None else self.confirm_episodes

    @property
    def measures(self) -> tuple[str, ...]:
        """The measures of the archive's axes; empty without an archive."""
        return tuple(axis.measure for axis in parse_axes(self._archive))

    @property
    def _archive(self) -> tuple[str, ...]:
        return tuple(each for each in self.archive if each not in ("", NO_ARCHIVE))

    @property
    def _hidden(self) -> int:
        return self.hidden_units if self.controller == "hidden" else 0

    def _resolve_with_bundle(self, bundle: Bundle) -> tuple[TaskSpec, ControllerShape, tuple[str, ...]]:
        self._check_world(bundle)
        if self.environment or self.observation or self.normalise or self.task_options:
            raise UsageError(
                "--environment, --observation, --normalise and --task-options are of tasks without a world model"
            )
        if self.recorded:
            bundle.check_recorded()
        driving, facts = self._driving(bundle), bundle.manifest.facts
        shape = bundle.with_controllers(
            bundle.shape_of(self.features, self._hidden, driving), driving
        ).controller_shape  # fmt: skip
        own_shape = None if shape == bundle.default_shape else shape
        end = self.end and EndRule.parse(self.end).text
        end = "" if end == facts.end.text else end  # so that it scores as a run that names none
        version = driving.version + (OWN_END_VERSION if end else 0)
        spec = replace(self._spec(bundle.sha256, own_shape, driving.options, version), end=end)
        return spec, shape, facts.packages

    def _check_world(self, bundle: Bundle) -> None:
        """`UsageError` for a world model that the task surely cannot use; other packages' tasks may use CarRacing's."""
        task, world = str(self.task), bundle.manifest.task
        check_preset_fits(self.preset, world, bundle.path.name)
        if task in (DREAM, world):
            return
        if world != FIRST_WORLD or is_shipped(task):
            without = "; or without a world model: --bundle none" if task.partition(":")[0] == GYM else ""
            raise UsageError(
                f"{bundle.path.name} is a world model of {world}, and not of {task}: name one of that with --bundle"
                f"{without}"
            )

    def _spec(self, bundle: str, shape: ControllerShape | None, options: str, version: int) -> TaskSpec:
        values = frozen_values(TaskSpec, self)
        return TaskSpec(**values, bundle=bundle, controller=shape, options=options, version=version)

    def _driving(self, bundle: Bundle) -> Driving:
        """How the run's controllers drive."""
        given, preset = (
            parse_arguments("--variant", each, "pedals=one") for each in (self.variant, self.preset_variant)
        )
        values, world = preset | given, bundle.manifest.task
        driving = bundle.driving_of(json.dumps(values, sort_keys=True) if values else "")
        if not driving.is_default and self.task not in (world, DREAM):
            raise UsageError(f"task {self.task} has no variants: {world} has, and its dream")
        costs = [each for each in driving.option_texts if each not in driving.without_costs.option_texts]
        drives = self.driven > 0 or any(each.driven for each in self.stages)
        if costs and self.task == DREAM and not drives:
            cost = costs[0].partition("=")[0]
            remedy = "omit it from --variant" if cost in given else f"pass --variant {cost}=0 over the preset's"
            raise UsageError(
                f"{cost} needs candidates that drive in the world: a dream has no lap and no road; {remedy}"
            )
        return driving

    def _resolve_without_bundle(self) -> tuple[TaskSpec, ControllerShape, tuple[str, ...]]:
        check_preset_fits(self.preset, str(self.task))
        if self.temperature is not None or self.collect_every or self.variant:
            given = {
                "--temperature": self.temperature is not None,
                "--collect-every": self.collect_every,
                "--variant": self.variant,
            }
            named = " and ".join(flag for flag, is_given in given.items() if is_given)
            raise UsageError(f"{named}: only tasks with a world model take this; omit it for {self.task}")
        assert self.task is not None
        description = self.description or describe_task(self.task, self.description_options())
        options = description.options if self.task_options is None else self.task_options
        if self._hidden and not description.observations:
            raise UsageError(f"{self.task} observes nothing, so there is no controller: leave --controller out")
        shape = ControllerShape(description.observations, description.outputs, self._hidden)
        if len(options) > MAX_OPTIONS:
            raise UsageError(
                f"the options of {self.task} to freeze with the run have {len(options)} characters, {MAX_OPTIONS} at "
                "most: omit --normalise, or give smaller arguments"
            )
        check_normalisation(options, description.observations)
        return self._spec("", shape, options, description.version), shape, description.packages

    def description_options(self) -> dict[str, Any]:
        """The options under which the task describes itself."""
        if self.task_options is not None:
            return parse_described(self.task_options)
        arguments = parse_arguments("--environment", self.environment, "continuous=true")
        options: dict[str, Any] = {"environment": arguments} if arguments else {}
        if self.observation:
            options["observation"] = list(self.observation)
        return options | ({"normalise": True, "seed": self.seed} if self.normalise else {})


@lru_cache
def default_world() -> str:
    """The task of the world model that a run has unless it names one."""
    return find_bundle(DEFAULT_BUNDLE).manifest.task


def frozen_values(record: type, source: Any) -> dict[str, Any]:
    """The settings that runs freeze in `record`, read from a `RunConfig` or from such a record."""
    return {
        each.name: getattr(source, each.name) for each in fields(RunConfig) if each.metadata.get("record") is record
    }


def config_values(run: RunSettings, bundle: Path) -> dict[str, Any]:
    """The settings of a run as they would be configured; `bundle` is the path of its copy of the world model."""
    spec, hidden = run.task, run.controller.hidden
    values = frozen_values(RunSettings, run) | frozen_values(TaskSpec, spec)
    values |= {"controller": "hidden", "hidden_units": hidden} if hidden else {"controller": "linear"}
    if not spec.bundle:
        return {**values, "bundle": NO_BUNDLE, "task_options": spec.options}
    return {**values, "bundle": str(bundle), "variant": Variant.from_json(spec.options).option_texts}


@contextmanager
def _naming_stage(number: int | None) -> Iterator[None]:
    """Name the stage in an error; `None`: the run has no schedule."""
    try:
        yield
    except UsageError as error:
        raise error if number is None else UsageError(f"stage {number}: {error}") from error
