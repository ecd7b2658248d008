"""The dashboard's address and token. Tests coordinator/addons/web/address.py."""

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.addons.dashboard.config import DashboardConfig

TOKEN = "correct horse battery"
REACHABLE = ("0.0.0.0", "::", "192.168.1.5", "example.org", "")


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.7", "localhost", "::1", *REACHABLE])
def test_only_a_loopback_address_needs_no_token(host):
    config = DashboardConfig(host=host, token=TOKEN if host in REACHABLE else None)
    assert config.is_loopback == (host not in REACHABLE)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        *(({"host": host}, "--token") for host in REACHABLE),
        ({"token": "short"}, r"--token.*\b12\b"), ({"port": -1}, "--port"), ({"port": 65536}, "--port"),
    ],
)  # fmt: skip
def test_what_is_no_address_or_token_or_lacks_one_is_refused(changes, named):
    with pytest.raises(UsageError, match=named):
        DashboardConfig(**changes)


def test_an_address_can_be_opened_and_its_repr_hides_the_token():
    assert TOKEN not in repr(DashboardConfig(token=TOKEN))
    assert DashboardConfig().url(8420) == "http://127.0.0.1:8420"
    assert DashboardConfig(host="::1").url(1) == "http://[::1]:1"
