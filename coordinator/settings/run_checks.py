"""Checks of a run's settings against its world model and its optimiser."""

from __future__ import annotations

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import describe_bundle
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.stages import Stage

NO_SUBSPACE = "none"


def check_subspace(subspace: Subspace, spec: TaskSpec, shape: ControllerShape, bundle: Bundle | None) -> None:
    """`UsageError` for a subspace of another world model, or of controllers with other inputs."""
    if bundle is None or subspace.bundle not in bundle.same_models:
        raise UsageError(
            f"--subspace (given, or the preset's) belongs to {describe_bundle(subspace.bundle)}, "
            f"the run uses {describe_bundle(spec.bundle)}: "
            f"give its own --bundle, or --subspace {NO_SUBSPACE}"
        )
    if (inputs := subspace.weights.shape[1]) != shape.features:
        raise UsageError(
            f"--subspace fits controllers that see {plural(inputs, 'number')}, latent and hidden state alone, "
            "and this run's "
            f"see {shape.features}: omit --features and feedback=last, or pass --subspace {NO_SUBSPACE}"
        )


def try_optimiser(settings: RunSettings, stage: Stage, subspace: Subspace | None) -> None:
    """Build the run's optimiser once, so that a search which it cannot do is refused before the run exists."""
    from dreamfleet.coordinator.optimisers.evolution import (  # heavy: `--help` reads this module too
        Evolution,
        EvolutionConfig,
    )

    evolution = Evolution(EvolutionConfig.of(settings, stage, subspace))
    if settings.on_failure == "redraw":
        if stage.racing:
            raise UsageError("--on-failure redraw cannot be combined with --racing: a late candidate has no first half")
        evolution.check_redraws()
