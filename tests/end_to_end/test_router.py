"""Routers of their own: coordinator and workers only connect out, and meet there.
Tests common/addons/router/verb.py."""

import json
import tomllib
from pathlib import Path
from threading import Event, Thread

import pytest
import zenoh

from dreamfleet.common.addons.router import verb
from dreamfleet.common.security.certificate_ledger import RevocationWatcher
from dreamfleet.common.transport import link_check
from dreamfleet.common.transport.network import Network
from dreamfleet.common.transport.session import open_session, zenoh_config
from tests.support import tasks
from tests.support.hosts import new_host, require_hosts
from tests.support.processes import DEADLINE, free_port, processes_in, until
from tests.support.relay import Relay
from tests.support.same_bits import evolve, outcome

ANY = "0.0.0.0:7447"
RECIPES = Path(__file__).parents[2] / "deploy" / "zenoh"


@pytest.fixture
def recipe(tmp_path):
    """Writes a recipe's file with the addresses of this test in place of its examples."""

    def write(name, addresses):
        text = (RECIPES / name).read_text()
        for example, address in addresses.items():
            assert example in text
            text = text.replace(example, address)
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


@pytest.fixture(scope="module")
def settings(small):
    return (*small, "--beat", 0.2, "--generations", 4)


@pytest.fixture(scope="module")
def alone(tmp_path_factory, settings):
    """What the run comes to where nothing stands between."""
    with processes_in(tmp_path_factory.mktemp("alone")) as processes:
        return evolve(processes, "alone", 1, *settings, "--task", tasks.TOY, task=tasks.TOY)


@pytest.mark.slow
def test_two_linked_routers_one_of_which_is_killed_cost_no_bit(processes, recipe, settings, alone):
    one, two = (f"127.0.0.1:{free_port()}" for _ in range(2))
    first = recipe("one.toml", {ANY: one, "router.example:7447": one})
    second = recipe("linked.toml", {ANY: two, "router.example:7447": one, "second.example:7447": two})
    linked = processes.start("router", "--config", second)  # either may start first
    linked.wait_for_event("begin")
    router = processes.start("router", "--config", first)
    router.wait_for_event("begin")
    coordinator = processes.coordinator(*settings, name="far", at=("--config", first))
    worker = processes.start("worker", "--config", second, "--run", "far", "--task", tasks.SLOW_TOY, "--slots", 1)
    worker.wait_for_event("joined")
    coordinator.wait_for_event("generation", number=1)
    router.end()
    processes.start("router", "--config", first).wait_for_event("begin")
    assert coordinator.finish()[0] == 0
    assert linked.stop()[0] == 0
    assert linked.events("sessions")[-1]["routers"] == 1
    assert outcome(processes, "far") == alone


@pytest.mark.slow
def test_a_coordinator_that_nobody_reaches_meets_workers_of_another_network_at_a_router(
    processes, recipe, settings, alone
):
    """Each on a cable of its own to the router's host, which passes no packets on."""
    with new_host() as inside, new_host() as elsewhere:
        require_hosts(inside, elsewhere)
        near, own = [], {ANY: f"127.0.0.1:{processes.port}"}
        addresses = [f"{host.address}:{processes.port}" for host in (inside, elsewhere)]
        for number, address in enumerate(addresses):
            file = recipe("one.toml", {**own, "router.example:7447": address})
            near.append(file.rename(processes.folder / f"{number}.toml"))
        listen = [f"tcp/{address}" for address in addresses]
        processes.start("router", "--insecure", "--listen", *listen).wait_for_event("begin")
        coordinator = processes.coordinator(*settings, name="nat", at=("--config", near[0]), inside=inside.inside)
        worker = processes.start("worker", "--config", near[1], "--run", "nat", "--task", tasks.SLOW_TOY, "--slots", 2,
                                 inside=elsewhere.inside)  # fmt: skip
        worker.wait_for_event("joined")
        assert coordinator.finish()[0] == 0
    assert outcome(processes, "nat") == alone


@pytest.mark.parametrize("name", ["one.toml", "linked.toml"])
def test_what_is_printed_for_zenohd_is_the_routers_own_configuration(processes, name):
    out = processes.printed("router", "--config", RECIPES / name, "--print-config")
    config, wanted = json.loads(out), tomllib.loads((RECIPES / name).read_text())["router"]
    assert config["mode"] == "router"
    assert (config["listen"]["endpoints"], config["connect"]["endpoints"]) == (
        wanted["listen"],
        wanted.get("connect", []),
    )
    config["listen"]["endpoints"] = [f"tcp/127.0.0.1:{free_port()}"]
    config["connect"]["endpoints"] = []
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))):  # unknown keys raise
        pass


def test_a_port_in_use_is_one_line(processes):
    processes.start("router", "--listen", processes.endpoint).wait_for_event("begin")
    code, _, err = processes.call("router", "--listen", processes.endpoint)
    assert (code, str(processes.port) in err, "Traceback" in err) == (1, True, False), err


def routers_of(session):
    return [str(each.zid) for each in session.info.transports() if str(each.whatami) == "router"]


@pytest.mark.slow
def test_a_router_whose_id_another_session_has_begins_again_with_another_id(monkeypatch, tmp_path):
    monkeypatch.setattr(link_check, "LINK_TIMEOUT", 1.0)
    monkeypatch.setattr(verb, "CHECK_INTERVAL", 0.1)
    far, near = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    stopped = Event()
    relay = Relay(int(far.rpartition(":")[2]))
    relay.hold()
    thread = Thread(
        target=verb.run_router,
        args=(Network(listen=(near,), connect=(relay.endpoint,)), stopped, RevocationWatcher(tmp_path, None)),
    )
    thread.start()
    try:
        with open_session(Network(connect=(near,)), timeout=DEADLINE) as client:
            (taken,) = map(str, client.info.routers_zid())
        with open_session(Network(listen=(far,)), timeout=None) as other:
            double = zenoh_config(Network(connect=(far,)), DEADLINE) | {"id": taken}
            with zenoh.open(zenoh.Config.from_json5(json.dumps(double))):
                relay.release()
                until(lambda: routers_of(other))
                assert taken not in routers_of(other)
    finally:
        stopped.set()
        thread.join()
        relay.close()
