"""What a task is asked for: an environment, a policy or a batch of one run."""

from __future__ import annotations

from dataclasses import dataclass

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.errors import BundleError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.tasks.world import ENVIRONMENT_LIMIT


@dataclass(frozen=True)
class Assignment:
    """What is scored: a run's specification and, for tasks that need one, its world model."""

    spec: TaskSpec
    bundle: Bundle | None = None
    torch_device: str = ""  # that batches may compute on, such as "cuda"; empty: the processor's core

    def __post_init__(self) -> None:
        """`BundleError` if the bundle is not the one that the specification names."""
        if self.bundle is not None and self.bundle.sha256 != self.spec.bundle:
            raise BundleError(
                f"{self.bundle.path} is the world model {self.bundle.sha256[:12]}..., and what is scored in is "
                f"{self.spec.bundle[:12]}...: put the right one there"
            )

    @classmethod
    def of(cls, task: str, bundle: Bundle) -> Assignment:
        """A task with a world model, outside of any run."""
        return cls(TaskSpec(task, bundle.sha256, ENVIRONMENT_LIMIT, 0), bundle)

    @property
    def world_model(self) -> Bundle:
        """The bundle for the run's controllers, which drive by its options; `BundleError` if there is no bundle."""
        spec = self.spec
        if self.bundle is None:
            raise BundleError(f"task {spec.task} needs a world model: give one with --bundle")
        own = spec.controller or spec.options
        return self.bundle.with_options(spec.controller, spec.options) if own else self.bundle

    @property
    def controller(self) -> ControllerShape:
        """The shape of the controllers that are scored."""
        return self.spec.controller or self.world_model.controller_shape
