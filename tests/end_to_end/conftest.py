import pytest

from tests.support import tasks
from tests.support.attacks import SETTINGS, outcome
from tests.support.processes import processes_in


@pytest.fixture(scope="session")
def unharmed(tmp_path_factory, random_bundle):
    """What the run comes to that nobody attacks, at an open port: certificates change no bit."""
    with processes_in(tmp_path_factory.mktemp("unharmed")) as processes:
        coordinator = processes.coordinator("--bundle", random_bundle.path, *SETTINGS)
        processes.worker("--task", tasks.SLOW_TOY, "--name", "own")
        assert coordinator.finish()[0] == 0
        return outcome(processes)
