"""A controller that drives for a data set."""

from __future__ import annotations

from dataclasses import dataclass

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import ControllerError
from dreamfleet.worker.scoring.actors import ControllerActor
from dreamfleet.worker.scoring.disturbance import ActionBursts, Disturbance, DisturbedPolicy
from dreamfleet.worker.training.data.dataset import WORLD, find_world
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState


@dataclass(frozen=True)
class Pilot:
    """A controller with the world model that it was evolved with."""

    controller: Controller
    bundle: Bundle

    def check(self, preprocessing: str) -> None:
        """`ControllerError` unless its task is the data sets' world and its pictures have this preprocessing."""
        manifest = self.bundle.manifest
        if self.controller.bundle != self.bundle.sha256:
            raise ControllerError(
                f"the controller is of the world model {self.controller.bundle[:12]}..., not of {self.bundle.path}"
            )
        if (manifest.task, manifest.preprocessing) != (WORLD, preprocessing):
            raise ControllerError(
                f"the controller sees {manifest.preprocessing!r} of {manifest.task}, and the data set holds "
                f"{preprocessing!r} of {WORLD}: choose another --picture, or another --controller"
            )

    def policy(self, noise: float, bursts: float, seed: int) -> DisturbedPolicy:
        """The policy of one drive, with noise and bursts of tried actions by the seed."""
        actions = find_world().world.actions
        if not isinstance(actions, Continuous):
            raise ControllerError(f"{WORLD} has no continuous actions: its drives cannot be disturbed")
        actor = ControllerActor(
            self.controller, self.bundle, RecurrentState(self.bundle.for_controller(self.controller))
        )
        tried = ActionBursts(seed, actions, bursts) if bursts else None
        return DisturbedPolicy(actor, Disturbance(seed, actions, noise), bursts=tried)
