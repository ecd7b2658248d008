"""A search of somebody else's over a real fleet: batches over Zenoh, and what is killed amid one.

Tests common/addons/batches/batch_client.py, common/addons/batches/remote_scorer.py and
coordinator/service/batch_queries.py.
"""

import subprocess
import sys

import numpy as np
import pytest

from dreamfleet import RemoteScorer
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.protocol.batches import BatchError
from tests.support import tasks
from tests.support.access import begin as begin_secured
from tests.support.access import until
from tests.support.batches import PATIENCE, SIZE, begin, count_results, resume, rows, scorer, vectors
from tests.support.processes import ROOT, call_here, environment, started
from tests.support.relay import Relay

CALLER = """
import sys, numpy as np
from dreamfleet import RemoteScorer
with RemoteScorer(sys.argv[1], "test") as scorer:
    batch = scorer.submit(np.load(sys.argv[2]), seeds=[1, 2], batch_id="mine")
    print(batch.state, flush=True)
    for found in batch.results():
        print("scored", found.index, flush=True)
"""


@pytest.fixture
def fleet(processes, random_bundle):
    begin(processes, random_bundle)
    processes.worker("--task", tasks.TOY)
    return processes


@pytest.mark.slow
def test_batches_are_scored_and_the_same_content_is_never_scored_twice(fleet):
    with scorer(fleet) as search:
        assert search.size == SIZE
        first = search.score(vectors(5), seeds=[1, 2], batch_id="a")
        assert np.isfinite(first).all()
        assert len(set(first)) == 5
        assert (search.score(vectors(5), seeds=[1, 2], batch_id="a") == first).all()  # found by its id
        assert (search.score(vectors(5), seeds=[1, 2], batch_id="b") == first).all()  # another batch, the same jobs
        assert count_results(fleet)[0] == 10
        mixed = search.score(vectors(7)[2:], seeds=[2, 3])
        assert np.isfinite(mixed).all()
        assert [found.index for found in search.find("a").results()] == [0, 1, 2, 3, 4]
        assert search.find("a").cancel() == "complete"
        drawn = search.submit(vectors(2), episodes=3)
        drawn.wait()
        assert drawn.refresh()._last.episodes == 3
        with Client(fleet.endpoint) as client:
            until(lambda: client.status("test").state == "waiting for a batch", "the run waits")
            assert client.status("test").settings.evaluate_every == 0
    for verb in (("status", "--connect", fleet.endpoint), ("story", "--connect", fleet.endpoint),
                 ("runs", "list", "--runs-dir", fleet.runs), ("runs", "show", "test", "--runs-dir", fleet.runs),
                 ("runs", "plot", "test", "--runs-dir", fleet.runs, "--out", fleet.folder / "a.png")):  # fmt: skip
        code, out, err = fleet.call(*verb)
        assert code == 0, (verb, err)
        assert "step size" not in out
    code, out, err = fleet.call("verify", "candidate", "test", "--candidate", "0/1", "--runs-dir", fleet.runs)
    assert code == 0, err


def test_wrong_batches_are_refused_and_lose_nothing(fleet):
    with scorer(fleet) as search:
        fitness = search.score(vectors(2), seeds=[1], batch_id="kept")
        for wrong, refusal in (
            (np.zeros((2, 3)), "malformed"),
            (np.full((2, SIZE), np.nan), "malformed"),
            (np.full((2, SIZE), 1e39), "malformed"),
            (np.zeros((0, SIZE)), "malformed"),
            (np.zeros(SIZE), "malformed"),
            ([[1.0], [2.0, 3.0]], "malformed"),
            (np.zeros((10_000, 1000), np.float32), "too large"),
        ):
            with pytest.raises(BatchError) as error:
                search.submit(wrong)
            assert error.value.refusal == refusal
        for seeds in ([], [-1], [2**53], [1.5], [True]):
            with pytest.raises(BatchError) as error:
                search.submit(vectors(1), seeds=seeds)
            assert error.value.refusal == "malformed"
        with pytest.raises(BatchError, match="100,000"):
            search.submit(vectors(100), episodes=1001)
        with pytest.raises(BatchError):
            search.submit(vectors(1), seeds=[1], episodes=1)
        with pytest.raises(BatchError, match=r"\.\./a"):
            search.submit(vectors(1), batch_id="../a")
        with pytest.raises(BatchError, match="other"):
            search.find("other")
        with pytest.raises(BatchError) as taken:
            search.submit(vectors(2, 1.0), seeds=[1], batch_id="kept")
        assert taken.value.refusal == "conflict"
        assert (search.find("kept").wait() == fitness).all()
    with (
        RemoteScorer(fleet.endpoint, "nobody", patience=0.0) as lost,
        pytest.raises(ConnectionFailedError),
    ):
        lost.submit(vectors(1))


def test_a_run_with_its_own_search_takes_no_batch(processes, random_bundle):
    processes.coordinator("--bundle", random_bundle.path, "--task", tasks.TOY)
    with scorer(processes) as search, pytest.raises(BatchError, match="--optimiser"):
        search.submit(vectors(1))


@pytest.mark.parametrize("flags", [("--racing",), ("--generations", 3), ("--on-failure", "redraw"),
                                   ("--evaluate-every", 5)])  # fmt: skip
def test_what_needs_a_search_is_refused_for_an_external_run(processes, random_bundle, flags):
    code, _, err = call_here(
        "coordinator", "--bundle", random_bundle.path, "--task", tasks.TOY, "--optimiser", "external",
        "--runs-dir", processes.runs, "--listen", processes.endpoint, *flags,
    )  # fmt: skip
    assert code == 2
    assert flags[0] in err


@pytest.mark.slow
def test_a_failed_candidate_has_no_fitness_and_an_error(processes, random_bundle):
    begin(processes, random_bundle, task=tasks.BRITTLE)
    processes.worker("--task", tasks.BRITTLE)
    with scorer(processes) as search:
        fitness = search.score(vectors(16), seeds=[2, 3], batch_id="brittle")
        assert 0 < np.isnan(fitness).sum() < 16
        found = {each.index: each for each in search.find("brittle").results()}
        assert len(found) == 16
        for index, value in enumerate(fitness):
            assert (found[index].fitness is None) == bool(np.isnan(value))
            assert (found[index].error is not None) == bool(np.isnan(value))
        assert any("is brittle" in (each.error or "") for each in found.values())
        again = search.score(vectors(16), seeds=[2, 3], batch_id="again")  # failures are remembered too
        assert (np.isnan(again) == np.isnan(fitness)).all()


@pytest.mark.slow
def test_a_batch_is_cancelled_before_and_while_it_is_scored(processes, random_bundle):
    begin(processes, random_bundle, task=tasks.SLOW_TOY)
    processes.worker("--task", tasks.SLOW_TOY)
    with scorer(processes) as search:
        open_one = search.submit(vectors(30), seeds=[1], batch_id="open")
        waiting = search.submit(vectors(3, 1.0), seeds=[1], batch_id="waiting")
        last = search.submit(vectors(2, 2.0), seeds=[1], batch_id="last")
        next(open_one.results())
        assert waiting.refresh().state == "waiting"
        assert waiting.cancel() == "cancelled"
        assert open_one.cancel() == "cancelled"
        assert np.isfinite(last.wait()).all()
        found = list(open_one.results())
        assert len(found) == 30
        assert 0 < sum(each.fitness is not None for each in found) < 30
        assert {each.error for each in found} == {None, "cancelled"}
        assert {each.error for each in waiting.results()} == {"cancelled"}


@pytest.mark.slow
def test_a_caller_that_was_killed_goes_on_and_nothing_is_scored_twice(processes, random_bundle, tmp_path):
    begin(processes, random_bundle, task=tasks.SLOW_TOY)
    processes.worker("--task", tasks.SLOW_TOY)
    np.save(tmp_path / "vectors.npy", vectors(12))
    command = [sys.executable, "-c", CALLER, processes.endpoint, str(tmp_path / "vectors.npy")]

    def call():
        return started(command, env=environment(processes.cache), stdout=subprocess.PIPE, text=True, cwd=ROOT)

    with call() as first:
        while not first.stdout.readline().startswith("scored 1"):
            pass
        first.kill()
    with call() as second:
        out, _ = second.communicate(timeout=PATIENCE)
    assert second.returncode == 0
    assert sorted(int(line.split()[1]) for line in out.splitlines() if line.startswith("scored")) == [*range(12)]
    assert count_results(processes) == (24, 240)
    assert rows(processes, "SELECT id, state FROM batch") == [("mine", "complete")]


@pytest.mark.slow
def test_a_batch_outlives_the_kill_of_its_coordinator(processes, random_bundle):
    coordinator = begin(processes, random_bundle, task=tasks.SLOW_TOY)
    processes.worker("--task", tasks.SLOW_TOY)
    with scorer(processes) as search:
        batch = search.submit(vectors(12), seeds=[1, 2], batch_id="mine")
        later = search.submit(vectors(2, 5.0), seeds=[1], batch_id="later")
        found = batch.results()
        next(found)
        coordinator.end()
        resume(processes)
        assert len([*found]) == 11
        assert np.isfinite(later.wait()).all()
        assert (search.score(vectors(12), seeds=[1, 2], batch_id="mine") == batch.wait()).all()
    assert count_results(processes) == (26, 260)
    assert rows(processes, "SELECT id, state FROM batch") == [("mine", "complete"), ("later", "complete")]


@pytest.mark.slow
def test_a_caller_waits_out_a_cut_link(fleet):
    relay = Relay(fleet.port)
    try:
        with scorer(fleet, relay.endpoint) as search:
            first = search.score(vectors(2), seeds=[1])
            relay.hold()
            relay.cut()
            with Client(fleet.endpoint) as client:
                assert client.status("test").generations == 1
            relay.release()
            assert (search.score(vectors(2), seeds=[1]) == first).all()
    finally:
        relay.close()


@pytest.mark.slow
def test_in_a_secured_fleet_only_an_operator_submits(processes, access, endpoint, random_bundle):
    begin_secured(processes, access, endpoint, random_bundle, "--optimiser", "external")
    processes.start("worker", "--join", access.path("first"), "--connect", endpoint, "--run", "safe", "--slots", 1,
                    "--task", tasks.SLOW_TOY)  # fmt: skip
    with RemoteScorer(access.network("operator", endpoint), "safe") as search:
        assert np.isfinite(search.score(vectors(2), seeds=[1], batch_id="own")).all()
    for who in ("viewer", "second"):
        with RemoteScorer(access.network(who, endpoint), "safe", patience=0.0) as other:
            with pytest.raises(ConnectionFailedError):
                other.submit(vectors(1))
            with pytest.raises(ConnectionFailedError):
                other.find("own")
