"""What a run is: its settings, which it freezes in its journal.

Each setting is one field. The bounds are in its annotation; `frozen_option` names the record that stores it.
"""

import json
from dataclasses import dataclass, field, fields
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.driving import FIRST_WORLD, Variant
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.artifacts.world_facts import EndRule
from dreamfleet.common.cli.bounds import check_bounds
from dreamfleet.common.cli.config import option
from dreamfleet.common.cli.key_values import parse_arguments
from dreamfleet.common.cli.presets import preset_help_text
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.measures import NO_ARCHIVE, parse_axes
from dreamfleet.common.protocol.messages import Horizon, Patience, Share, TaskSpec, Temperature
from dreamfleet.common.protocol.tasks import DREAM, Description, check_task, is_self_describing
from dreamfleet.common.runs.records import (
    EXTERNAL,
    ConfirmationEpisodes,
    EpisodesPerCandidate,
    OnFailure,
    PopulationSize,
    RunSettings,
    StageSettings,
)
from dreamfleet.common.schema.validation import Count

DEFAULT_BUNDLE, NO_BUNDLE, NO_SUBSPACE = "tiny", "none", "none"
DEFAULT_HORIZON = 1000  # steps
DEFAULT_UNITS = 8  # of a hidden controller's layer
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
    controller: Literal["linear", "hidden"] | None = option(
        None, "a linear map, or with a layer of tanh units (default hidden with --hidden-units, else linear)"
    )
    hidden_units: Annotated[int, Meta(ge=1, le=10**5)] | None = option(
        None, f"units of a hidden controller's layer (default {DEFAULT_UNITS})"
    )
    features: Literal["zh", "z"] = frozen_option(
        RunSettings, "zh", "what the controller sees: latent and hidden state, or latent alone"
    )
    population: PopulationSize = frozen_option(RunSettings, 32, "candidates a generation")
    episodes: EpisodesPerCandidate = frozen_option(
        RunSettings, 2, "episodes a candidate, on the same fresh seeds for all"
    )
    sigma0: float = frozen_option(RunSettings, 0.1, "first step size")
    optimiser: str = frozen_option(  # docs/reference/optimisers.md
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
    on_failure: OnFailure = frozen_option(  # docs/how-to/unattended.md
        RunSettings, "worst", "a candidate whose episode fails in two independent attempts: ranks last (worst), is "
        "drawn anew (redraw), or pauses the run (pause)",
    )  # fmt: skip
    seed: Count = frozen_option(RunSettings, 1, "makes the run: population and training seeds follow from it")
    evaluate_every: Interval = frozen_option(  # docs/explanation/sources.md
        RunSettings, 25, "drive the mean in reality every so many generations; 0: never"
    )
    evaluation_episodes: EpisodesPerCandidate = frozen_option(  # docs/tutorials/own-environment.md
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
        if self.controller == "linear" and self.hidden_units is not None:
            raise UsageError("--hidden-units is of --controller hidden, not linear: omit one of the two")
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
            self._check_mixture()
        if self.optimiser == EXTERNAL:
            self._check_external()

    def _check_external(self) -> None:  # docs/how-to/ask-tell.md
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

    def _check_mixture(self) -> None:
        """`UsageError` for a mixture of dreams and drives that no candidate can have."""
        if round(self.driven * self.episodes) in (0, self.episodes):
            raise UsageError(
                f"--driven {self.driven:g} of {plural(self.episodes, 'episode')} is none of them, or all: give "
                "another share, or more --episodes"
            )
        if self.racing:
            raise UsageError(
                "--racing compares all candidates by the first half of their episodes, and of a mixture that would be "
                "the driven ones: omit it, or pass --driven 0 or 1"
            )

    @property
    def units(self) -> int:
        """Units of the controller's layer; 0: it is linear."""
        return self.hidden_units or (DEFAULT_UNITS if self.controller == "hidden" else 0)

    @property
    def needs_no_bundle(self) -> bool:
        """Whether candidates are scored without a world model."""
        if self.bundle is not None or self.task in (None, DREAM):
            return self.bundle == NO_BUNDLE
        return self.task != default_world() and is_self_describing(self.task)

    @property
    def measures(self) -> tuple[str, ...]:
        """The measures of the archive's axes; empty without an archive."""
        return tuple(axis.measure for axis in parse_axes(self.axes))

    @property
    def axes(self) -> tuple[str, ...]:
        """The archive's axes; empty without an archive."""
        return tuple(each for each in self.archive if each not in ("", NO_ARCHIVE))

    def description_options(self) -> dict[str, Any]:
        """The options under which the task describes itself."""
        if self.task_options is not None:
            return _parse_described(self.task_options)
        arguments = parse_arguments("--environment", self.environment, "continuous=true")
        options: dict[str, Any] = {"environment": arguments} if arguments else {}
        if self.observation:
            options["observation"] = list(self.observation)
        return options | ({"normalise": True, "seed": self.seed} if self.normalise else {})


def _parse_described(text: str) -> dict[str, Any]:
    """The options by which a task describes itself, of those in the JSON object of --task-options."""
    try:
        plain = json.loads(text or "{}")
        observation = {"observation": list(plain["observation"])} if plain.get("observation") else {}
        return {"environment": dict(plain.get("environment", {})), **observation}
    except (ValueError, AttributeError, TypeError, RecursionError) as error:
        raise UsageError(f"--task-options must be a JSON object, not {text!r}") from error


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
    values |= {"controller": "hidden" if hidden else "linear", "hidden_units": hidden or None}
    if not spec.bundle:
        return {**values, "bundle": NO_BUNDLE, "task_options": spec.options}
    return {**values, "bundle": str(bundle), "variant": Variant.from_json(spec.options).option_texts}
