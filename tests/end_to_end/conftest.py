import pytest

from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support import tasks
from tests.support.access import Access
from tests.support.attacks import SETTINGS, outcome
from tests.support.browser import chromium
from tests.support.bundles import write_random_bundle
from tests.support.processes import free_port, processes_in
from tests.support.sshd import ssh_hosts


@pytest.fixture(scope="session")
def random_bundle(tmp_path_factory):
    """A world model of few megabytes: nearly all tests here only hand it on, from file to file and over the network."""
    path = tmp_path_factory.mktemp("bundle") / "random.zip"
    return write_random_bundle(path, vae=VAEConfig(channels=(8, 16, 32, 64)))


@pytest.fixture(scope="session")
def small(random_bundle):
    """Flags of a run of four candidates that takes a second a generation; what stands behind them counts more."""
    return ("--bundle", random_bundle.path, "--population", 4, "--episodes", 1, "--evaluate-every", 0,
            "--task", tasks.SLOW_TOY)  # fmt: skip


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


@pytest.fixture(scope="session")
def unharmed(tmp_path_factory, random_bundle):
    """What the run comes to that nobody attacks, at an open port: certificates change no bit."""
    with processes_in(tmp_path_factory.mktemp("unharmed")) as processes:
        coordinator = processes.coordinator("--bundle", random_bundle.path, *SETTINGS)
        processes.worker("--task", tasks.SLOW_TOY, "--name", "own")
        assert coordinator.finish()[0] == 0
        return outcome(processes)


@pytest.fixture(scope="module")
def access(tmp_path_factory):
    return Access(tmp_path_factory.mktemp("certificates") / "access")


@pytest.fixture
def endpoint():
    return f"tls/127.0.0.1:{free_port()}"


@pytest.fixture
def hosts(tmp_path):
    with ssh_hosts(tmp_path) as found:
        yield found
