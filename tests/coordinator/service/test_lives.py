"""One coordinator serves a run that was taken back in another incarnation. Tests coordinator/service/main.py and
coordinator/verbs/bar.py."""

from contextlib import nullcontext
from itertools import product
from types import SimpleNamespace

import pytest

from dreamfleet.common.cli.command_line import main as call
from dreamfleet.common.client import client
from dreamfleet.common.errors import ConnectionFailedError, UsageError
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.run_lock import run_lock
from dreamfleet.common.security.certificate_ledger import LEDGER_FILE
from dreamfleet.common.security.credentials import read_join_file
from dreamfleet.coordinator.run.recall import bar_stored
from dreamfleet.coordinator.service import main
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.verbs import bar
from tests.support.access import Access
from tests.support.failing_runs import SETTINGS, finished

LEDGERS = {"missing": lambda path: path.unlink(), "half copied": lambda path: path.write_bytes(path.read_bytes()[:99])}


@pytest.mark.parametrize(("ledger", "asked"), [*product(LEDGERS, [False]), ("missing", True)])
def test_the_next_life_keeps_the_lock_and_the_revoked_seats(tmp_path, random_bundle, monkeypatch, ledger, asked):
    bench = finished(tmp_path / "runs", random_bundle, fails=lambda _: False)
    bench.run.leave()
    bench.journal.close()
    access = Access(tmp_path / "access")
    access.authority.revoke("first")
    seats, revoked = [], {"worker.1"}

    def resolve(request, folder):
        """Between two incarnations nobody else gets the run."""
        if seats:
            with pytest.raises(UsageError):
                bar_stored(folder, "b", is_barred=True)
        return SETTINGS, None, 0

    def serve(open_run):
        run = open_run().run
        if len(seats) == 1:  # as it is asked to stop, or not
            assert run.bar("a") == ""
            LEDGERS[ledger](access.folder / LEDGER_FILE)
        return run

    def service(name, network, intervals, metrics_port, revocations, word):
        seats.append(revocations.revoked_seats)
        return SimpleNamespace(stop=lambda: None, serve=serve, is_asked_to_stop=asked)

    monkeypatch.setattr(main, "_resolve_settings", resolve)
    monkeypatch.setattr(main, "Service", service)
    request = main.RunRequest(
        bench.path.name, bench.path.parent, None, LimitsConfig(), NetworkConfig(),
        credentials=read_join_file(access.path("coordinator")), access_dir=access.folder,
    )  # fmt: skip
    run = main.serve_run(request)
    assert run.state.is_rewound == asked
    assert list(run.admission.barred) == ["a"]
    assert seats == [revoked] * (1 if asked else 2)
    with run_lock(bench.path):
        pass


def test_a_coordinator_between_two_lives_is_asked_again(tmp_path, random_bundle, monkeypatch):
    bench = finished(tmp_path / "runs", random_bundle, fails=lambda _: False)
    bench.journal.close()
    asked = []

    def control(*about):
        asked.append(about)
        if len(asked) < 3:
            raise ConnectionFailedError("nobody answers")

    monkeypatch.setattr(client, "Client", lambda _: nullcontext(SimpleNamespace(control=control)))
    monkeypatch.setattr(bar, "sleep", lambda seconds: None)
    with run_lock(bench.path):
        assert call(["bar", "a", "night", "--runs-dir", str(bench.path.parent)]) == 0
    assert asked == [("night", "bar", "a")] * 3
    with RunFolder(bench.path) as run:
        assert run.ended
