"""Somebody takes the Zenoh id of a coordinator whose link was cut. Tests service.py, name_lock.py and
common/transport/link_check.py."""

import json
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import replace

import pytest
import zenoh

from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import RefusedError
from dreamfleet.common.protocol import keys
from dreamfleet.common.transport import link_check
from dreamfleet.common.transport.network import Network
from dreamfleet.common.transport.query import query_all
from dreamfleet.common.transport.session import open_session, zenoh_config
from dreamfleet.coordinator.service import main
from dreamfleet.coordinator.service.name_lock import NameLock
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from tests.support.failing_runs import SETTINGS, Failing
from tests.support.processes import DEADLINE, free_port, until
from tests.support.relay import Relay


@pytest.fixture
def night(tmp_path, random_bundle):
    """An open run's folder."""
    settings = replace(SETTINGS, task=replace(SETTINGS.task, bundle=random_bundle.sha256))
    bench = Failing(tmp_path / "runs" / "night", random_bundle.path, settings, fails=lambda _: False)
    bench.run.leave()
    bench.journal.close()
    return bench.path


def answering(client):
    """The ids of the sessions that answer for the run."""
    replies = client.session.get(keys.status("night"), timeout=1.0)
    return [str(each.replier_id.zid) for each in replies if each.ok is not None]


def session_ids(router):
    return [str(each.zid) for each in router.info.transports()]


@pytest.mark.slow
@pytest.mark.parametrize("listens", [False, True])
def test_a_coordinator_whose_id_another_session_took_goes_on_under_another(night, random_bundle, monkeypatch, listens):
    monkeypatch.setattr(link_check, "LINK_TIMEOUT", 1.0)
    far = f"tcp/127.0.0.1:{free_port()}"
    own = (f"tcp/127.0.0.1:{free_port()}",) if listens else ()
    stops = []
    with ExitStack() as stack:
        router = stack.enter_context(open_session(Network(listen=(far,))))
        relay = stack.enter_context(closing(Relay(int(far.rpartition(":")[2]))))
        network = NetworkConfig(listen=own, connect=(relay.endpoint,))
        request = main.RunRequest("night", night.parent, None, LimitsConfig(), network)
        served = stack.enter_context(ThreadPoolExecutor(1)).submit(main.serve_run, request, stops.append)
        until(lambda: stops)
        stack.callback(stops[0])
        client = stack.enter_context(Client(far))
        until(lambda: served.done() or answering(client), "the run")
        assert not served.done(), served.result()
        (taken,), before = answering(client), client.status("night")
        relay.hold()
        relay.cut()
        until(lambda: taken not in session_ids(router), "the end of its session")
        double = zenoh_config(Network(connect=(far,)), DEADLINE) | {"id": taken}
        stack.enter_context(zenoh.open(zenoh.Config.from_json5(json.dumps(double))))
        relay.release()
        until(lambda: answering(client), "the run's return")
        assert taken not in answering(client)
        assert taken in session_ids(router)
        assert client.status("night").incarnation == before.incarnation
        assert len(list(query_all(client.session, [keys.bundle("night", random_bundle.sha256)], DEADLINE))) == 1
        with ExitStack() as rival, pytest.raises(RefusedError):
            NameLock(client.session, "night", "f" * 16, rival).acquire(linked=True)
        client.control("night", "stop")
        assert served.result(DEADLINE).state.ended is None
