"""A controller without an episode loop: observation and recurrent state in, action and next state out.

Pages: python.md.
"""

from copy import deepcopy
from threading import Lock
from typing import Any

import numpy as np

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import ControllerError
from dreamfleet.common.runs.lookup import find_bundle_of
from dreamfleet.worker.addons.evaluation.agents import make_agent


class EvolvedPredictor:
    """What `Controller.predict` calls: the controller's policy, which is loaded once. Threads may share it.

    A policy's attribute `state` is its recurrent state; one without such an attribute has none.
    """

    def __init__(self, controller: Controller, bundle: Bundle | None = None) -> None:
        """`ControllerError`, `BundleError` or `UsageError` if the controller cannot act on this host."""
        agent = make_agent(controller, bundle or find_bundle_of(controller, None))
        self._policy: Any = agent.make_policies()(0)
        self._parameters = controller.parameters
        self._lock = Lock()

    def predict(self, observation: Any, state: Any, reward: float | None) -> tuple[Any, Any]:
        """The action for an observation, and the state for the next call; `None` begins an episode."""
        with self._lock:
            self._policy.begin(self._parameters)
            if state is not None:
                self._restore(state)
                if reward is not None and hasattr(self._policy, "reward"):
                    self._policy.reward(reward)
            action = self._policy.act(observation)
            return action, deepcopy(getattr(self._policy, "state", None))

    def _restore(self, state: Any) -> None:
        own: Any = getattr(self._policy, "state", None)
        if np.shape(own) != np.shape(state):
            raise ControllerError(
                f"a state of shape {np.shape(state)} does not fit this controller's {np.shape(own)}: pass what its own "
                "predict returned, or None to begin an episode"
            )
        self._policy.state = deepcopy(state)
