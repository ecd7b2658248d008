"""What a run keeps of how it was served."""

import json

import pytest

from dreamfleet.common.errors import JournalError, UsageError
from dreamfleet.common.network import DEFAULT_ENDPOINT
from dreamfleet.common.runs import RunFolder
from dreamfleet.common.site import SiteConfig
from dreamfleet.coordinator.config import LimitsConfig, NetworkConfig, RunConfig
from dreamfleet.coordinator.journal import Journal
from dreamfleet.coordinator.kept import choose_addresses, facts_of, kept_limits, kept_network, settle_strict

HERE, THERE, FAR = "tcp/0.0.0.0:7610", "tcp/there:1", "tcp/far:2"


@pytest.fixture
def folder(tmp_path, random_bundle):
    Journal.create(tmp_path, RunConfig().settings(random_bundle), random_bundle.path).close()
    return tmp_path


def keep(folder, facts):
    journal = Journal(folder / "journal.sqlite")
    for name, text in facts.items():
        journal.set_fact(name, text)
    journal.commit()
    journal.close()


def test_limits_and_network_come_back_as_they_were(folder):
    limits, network = LimitsConfig(minutes=30.0, target=900.0), NetworkConfig((HERE,), (), 0.2, strict=True)
    keep(folder, facts_of(limits, network))
    with RunFolder(folder) as run:
        assert LimitsConfig(**kept_limits(run)) == limits
        assert NetworkConfig(**kept_network(run)) == network


@pytest.mark.parametrize(("kept", "strict"), [("{}", True), ('{"mixed": true}', False), ('{"strict": false}', False)])
def test_a_run_from_before_runs_said_so_was_strict_unless_it_was_mixed_and_goes_on_so(folder, kept, strict):
    with RunFolder(folder) as run:
        assert (kept_limits(run), kept_network(run)) == ({}, {"strict": True})
    keep(folder, {"network": kept})
    with RunFolder(folder) as run:
        assert kept_network(run) == {"strict": strict}


def test_mixed_loosens_a_strict_run_unless_strict_is_said_beside_it():
    asked = NetworkConfig(strict=True, mixed=True)
    assert settle_strict(asked, said=False) == NetworkConfig()
    assert settle_strict(asked, said=True) == NetworkConfig(strict=True)


def test_defaults_are_not_written_but_whether_a_run_is_strict():
    assert facts_of(LimitsConfig(), NetworkConfig()) == {"limits": "{}", "network": '{"strict": false}'}


@pytest.mark.parametrize("text", ["not JSON", "[]", '{"minutes": "many"}', json.dumps({"patience": 3})])
def test_what_is_damaged_or_of_a_later_version_is_said(folder, text):
    keep(folder, {"limits": text})
    with RunFolder(folder) as run, pytest.raises(JournalError, match="the limits kept with run"):
        kept_limits(run)


@pytest.mark.parametrize("target", [float("nan"), float("inf")])
def test_a_target_that_cannot_be_kept_is_refused(target):
    with pytest.raises(UsageError, match="--target must be a number"):
        LimitsConfig(target=target)


@pytest.mark.parametrize(
    ("own", "site", "kept", "addresses"),
    [
        ({}, {}, {}, ((DEFAULT_ENDPOINT,), ())),
        ({}, {}, {"listen": (HERE,)}, ((HERE,), ())),
        ({}, {}, {"connect": (THERE,)}, ((), (THERE,))),
        ({"listen": (FAR,)}, {}, {"listen": (HERE,), "connect": (THERE,)}, ((FAR,), ())),
        ({"connect": (FAR,)}, {}, {"listen": (HERE,)}, ((), (FAR,))),
        ({"listen": (HERE,), "connect": (THERE,)}, {}, {}, ((HERE,), (THERE,))),
        # One file for the whole fleet: the coordinator listens, and does not connect to itself.
        ({}, {"listen": (HERE,), "connect": (THERE,)}, {}, ((HERE,), ())),
        ({}, {"connect": (THERE,)}, {}, ((), (THERE,))),
        ({"listen": (HERE,)}, {"connect": (THERE,)}, {}, ((HERE,), ())),
    ],
)
def test_addresses_are_as_told_else_as_kept_else_this_host_alone(own, site, kept, addresses):
    chosen = choose_addresses(NetworkConfig(**own), SiteConfig(**site), kept)
    assert (chosen.listen, chosen.connect) == addresses


def test_where_everybody_connects_to_does_not_say_where_a_run_listened():
    kept = {"listen": (HERE,)}
    assert choose_addresses(NetworkConfig(), SiteConfig(connect=(THERE,)), kept).listen == (HERE,)
    assert choose_addresses(NetworkConfig(), SiteConfig(connect=(THERE,)), {}).connect == (THERE,)
    assert choose_addresses(NetworkConfig(connect=(FAR,)), SiteConfig(), kept).listen == ()
