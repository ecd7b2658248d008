"""The dashboard's address and token. Tests coordinator/addons/web/address.py."""

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.addons.dashboard.config import DashboardConfig

TOKEN = "correct horse battery"


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.7", "localhost", "::1"])
def test_a_loopback_address_needs_no_token(host):
    assert DashboardConfig(host=host).is_loopback


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", "example.org", ""])
def test_any_other_address_needs_one(host):
    with pytest.raises(UsageError, match="--token"):
        DashboardConfig(host=host)
    assert not DashboardConfig(host=host, token=TOKEN).is_loopback


@pytest.mark.parametrize(
    ("changes", "named"),
    [({"token": "short"}, r"--token.*\b12\b"), ({"port": -1}, "--port"), ({"port": 65536}, "--port")],
)
def test_what_is_no_address_or_token_is_refused(changes, named):
    with pytest.raises(UsageError, match=named):
        DashboardConfig(**changes)


def test_an_address_can_be_opened_and_its_repr_hides_the_token():
    assert TOKEN not in repr(DashboardConfig(token=TOKEN))
    assert DashboardConfig().url(8420) == "http://127.0.0.1:8420"
    assert DashboardConfig(host="::1").url(1) == "http://[::1]:1"
