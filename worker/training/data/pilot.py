"""A controller that drives for a data set."""

from dataclasses import dataclass

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import describe_bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import ControllerError
from dreamfleet.worker.scoring.actors import ControllerActor
from dreamfleet.worker.scoring.disturbance import ActionBursts, Disturbance, DisturbedPolicy
from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD, DataWorld
from dreamfleet.worker.training.data.dataset import find_world
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState


@dataclass(frozen=True)
class Pilot:
    """A controller with the world model that it was evolved with."""

    controller: Controller
    bundle: Bundle

    def check(self, preprocessing: str, world: DataWorld = OF_FIRST_WORLD) -> None:
        """`ControllerError` unless its task is the data set's world and its pictures have this preprocessing."""
        if self.controller.bundle != self.bundle.sha256:
            raise ControllerError(
                f"the controller belongs to {describe_bundle(self.controller.bundle)}, not to {self.bundle.path}"
            )
        own, seen = DataWorld.of(self.bundle), self.bundle.manifest.preprocessing
        if (own, seen) != (world, preprocessing):
            raise ControllerError(
                f"the controller sees {seen!r} of {own}, and the data set holds {preprocessing!r} of {world}: choose "
                f"another --picture, or another --controller"
            )

    def policy(self, noise: float, bursts: float, seed: int) -> DisturbedPolicy:
        """The policy of one drive, with noise and bursts of tried actions by the seed."""
        world = DataWorld.of(self.bundle)
        actions = find_world(*world).world.actions
        if not isinstance(actions, Continuous):
            raise ControllerError(f"{world} has no continuous actions: its drives cannot be disturbed")
        actor = ControllerActor(
            self.controller, self.bundle, RecurrentState(self.bundle.for_controller(self.controller))
        )
        tried = ActionBursts(seed, actions, bursts) if bursts else None
        return DisturbedPolicy(actor, Disturbance(seed, actions, noise), bursts=tried)
