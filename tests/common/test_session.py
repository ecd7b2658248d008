import pytest

from dreamfleet.common.errors import ConnectionFailedError, UsageError
from dreamfleet.common.session import Network, check_endpoint, open_session
from tests.support.processes import free_port


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:7447", "tls/host.example:1", "tcp/[::1]:7447"])
def test_good_endpoints(endpoint):
    assert check_endpoint(endpoint) == endpoint


@pytest.mark.parametrize("endpoint", ["", "127.0.0.1:7447", "tcp/host", "tcp/host:99999", "tcp/ host:1", "ftp/host:21"])
def test_bad_endpoints_are_refused(endpoint):
    with pytest.raises(UsageError, match="write it as tcp/HOST:PORT"):
        Network(listen=(endpoint,))


def test_a_port_in_use_says_so():
    network = Network(listen=(f"tcp/127.0.0.1:{free_port()}",))
    with open_session(network), pytest.raises(ConnectionFailedError, match=r"is in use: .*--listen"):
        open_session(network)


def test_nobody_there_says_so():
    with pytest.raises(ConnectionFailedError, match="nobody answers at"):
        open_session(Network(connect=(f"tcp/127.0.0.1:{free_port()}",)), timeout=0.2)
