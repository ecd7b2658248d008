"""Specifications of runs without a world model."""

from dreamfleet import ControllerShape, TaskSpec
from dreamfleet.common.protocol.tasks import describe_task


def described_spec(name, horizon=1000, **options):
    """As a coordinator freezes it: the task itself says what a controller observes and does."""
    about = describe_task(name, options)
    shape = ControllerShape(about.observations, about.outputs)
    return TaskSpec(name, "", horizon, 0, shape, options=about.options, version=about.version)
