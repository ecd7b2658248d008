"""What a run keeps of how it was served."""

import json
from contextlib import closing

import pytest

from dreamfleet.common.cli.global_config import GlobalConfig
from dreamfleet.common.errors import JournalError
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.transport.network import DEFAULT_ENDPOINT
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.settings.resume_settings import (
    choose_addresses,
    serving_facts,
    stored_limits,
    stored_network,
)
from dreamfleet.coordinator.storage.journal import Journal

HERE, THERE, FAR = "tcp/0.0.0.0:7610", "tcp/there:1", "tcp/far:2"


@pytest.fixture
def folder(tmp_path, random_bundle):
    Journal.create(tmp_path, freeze(RunConfig(), random_bundle), random_bundle.path).close()
    return tmp_path


def keep(folder, facts):
    with closing(Journal(folder / "journal.sqlite")) as journal:
        for each in facts.items():
            journal.set_fact(*each)
        journal.commit()


def test_limits_and_network_come_back_as_they_were_and_defaults_are_not_written(folder):
    assert serving_facts(LimitsConfig(), NetworkConfig()) == {"limits": "{}", "network": "{}"}
    limits, network = LimitsConfig(minutes=30.0, target=900.0), NetworkConfig((HERE,), (), 0.2, strict=True)
    keep(folder, serving_facts(limits, network))
    with RunFolder(folder) as run:
        assert LimitsConfig(**stored_limits(run)) == limits
        assert NetworkConfig(**stored_network(run)) == network


@pytest.mark.parametrize("text", ["not JSON", "[]", '{"minutes": "many"}', json.dumps({"patience": 3})])
def test_what_is_damaged_or_of_a_later_version_is_said(folder, text):
    keep(folder, {"limits": text})
    with RunFolder(folder) as run, pytest.raises(JournalError, match=f"limits .*{folder.name}"):
        stored_limits(run)


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
        ({}, {"connect": (THERE,)}, {"listen": (HERE,)}, ((HERE,), ())),
        ({"listen": (HERE,)}, {"connect": (THERE,)}, {}, ((HERE,), ())),
    ],
)
def test_addresses_are_as_configured_else_as_stored_else_this_host_alone(own, site, kept, addresses):
    chosen = choose_addresses(NetworkConfig(**own), GlobalConfig(**site), kept)
    assert (chosen.listen, chosen.connect) == addresses
