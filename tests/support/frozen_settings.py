"""What a run freezes, and begins with again."""

from dreamfleet.common.runs.records import RunSettings
from dreamfleet.coordinator.settings.config import RunConfig, config_values
from dreamfleet.coordinator.settings.freezing import freeze


def comes_back(settings, bundle, **more):
    """Whether a run's settings are the same out of its journal, and where they are configured again."""
    again = freeze(RunConfig(**config_values(settings, bundle.path), **more), bundle)
    return RunSettings.from_json(settings.to_json()) == settings == again
