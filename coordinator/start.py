"""Where a new run may begin instead of at zero: a controller's parameters, or the mean of another run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.controller import ControllerShape
from dreamfleet.common.errors import ControllerError, DreamfleetError
from dreamfleet.common.runs import RunFolder, open_run
from dreamfleet.common.shelf import find_controller
from dreamfleet.coordinator.checkpoint import Checkpoint


@dataclass(frozen=True)
class Start:
    """The first mean `(size,)`, and the world model it was evolved on; in the dream or in reality is all one."""

    mean: NDArray[np.float64]
    bundle: str  # SHA-256
    source: str

    def check(self, bundle: Bundle, shape: ControllerShape) -> None:
        """Refuse parameters that mean nothing to this world model and controller."""
        if self.bundle != bundle.sha256:
            raise ControllerError(
                f"{self.source} belongs to the world model {self.bundle[:12]}, not to {bundle.path.name} "
                f"({bundle.sha256[:12]}): give its own with --bundle"
            )
        if len(self.mean) != shape.size:
            raise ControllerError(
                f"{self.source} has {len(self.mean)} parameters, this run's controllers {shape.size}: give its own "
                "--controller, --hidden-units and --features"
            )


def find_start(name: str, runs_dir: Path) -> Start:
    """A controller's file, a run (its reported controller, or its mean while it is open), or what ships."""
    if not Path(name).is_file() and (runs_dir / name).is_dir():
        with open_run(runs_dir, name) as stored:
            if not stored.controller_path.is_file():
                return start_of(stored)
    controller, _ = find_controller(name, runs_dir)
    return Start(controller.parameters.astype(np.float64), controller.bundle, f"controller {name}")


def start_of(stored: RunFolder) -> Start:
    """The mean of a run's latest generation."""
    mean, _ = latest(stored)
    return Start(mean, stored.spec.bundle, f"run {stored.name}")


def latest(stored: RunFolder) -> tuple[NDArray[np.float64], float]:
    """Mean and step size of a run's latest generation, whichever optimiser wrote them."""
    state = stored.strategy_state()
    if state is None:
        raise DreamfleetError(f"run {stored.name} has no generation yet")
    head = Checkpoint.unpack(state).head
    return head.mean, head.sigma
