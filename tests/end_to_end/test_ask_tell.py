"""A search of somebody else's over a real fleet: batches over Zenoh, and what is killed amid one.

Tests common/addons/batches/batch_client.py, common/addons/batches/remote_scorer.py,
coordinator/service/batch_queries.py, coordinator/run/batches.py and coordinator/run/external_generations.py.
"""

import numpy as np
import pytest

from dreamfleet import RemoteScorer
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.protocol.batches import BatchError
from tests.support import tasks
from tests.support.batches import SIZE, begin, count_results, scorer, vectors
from tests.support.processes import until


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
            until(lambda: client.status("test").state == "waiting for a batch")
            assert client.status("test").settings.evaluate_every == 0
    for verb in (("status", "--connect", fleet.endpoint), ("story", "--connect", fleet.endpoint),
                 ("runs", "list", "--runs-dir", fleet.runs), ("runs", "show", "test", "--runs-dir", fleet.runs),
                 ("runs", "plot", "test", "--runs-dir", fleet.runs, "--out", fleet.folder / "a.png")):  # fmt: skip
        code, out, err = fleet.call(*verb)
        assert code == 0, (verb, err)
        assert "step size" not in out
    fleet.printed("verify", "candidate", "test", "--candidate", "0/1", "--runs-dir", fleet.runs)


def test_wrong_batches_are_refused_and_lose_nothing(fleet):
    with scorer(fleet) as search:
        fitness = search.score(vectors(2), seeds=[1], batch_id="kept")
        shapes = ((2, 3), 0.0), ((2, SIZE), np.nan), ((2, SIZE), 1e39), ((0, SIZE), 0.0), ((SIZE,), 0.0)
        wrong = [(np.full(*each), {}, "malformed") for each in shapes]
        wrong += [(vectors(1), {"seeds": each}, "malformed") for each in ([], [-1], [2**53], [1.5], [True])]
        wrong += [
            ([[1.0], [2.0, 3.0]], {}, "malformed"),
            (np.zeros((10_000, 1000), np.float32), {}, "too large"),
            (vectors(2, 1.0), {"seeds": [1], "batch_id": "kept"}, "conflict"),
        ]
        for batch, more, refusal in wrong:
            with pytest.raises(BatchError) as error:
                search.submit(batch, **more)
            assert error.value.refusal == refusal
        with pytest.raises(BatchError, match="100,000"):
            search.submit(vectors(100), episodes=1001)
        with pytest.raises(BatchError):
            search.submit(vectors(1), seeds=[1], episodes=1)
        with pytest.raises(BatchError, match=r"\.\./a"):
            search.submit(vectors(1), batch_id="../a")
        with pytest.raises(BatchError, match="other"):
            search.find("other")
        assert (search.find("kept").wait() == fitness).all()
    with RemoteScorer(fleet.endpoint, "nobody", timeout=0.0) as lost, pytest.raises(ConnectionFailedError):
        lost.submit(vectors(1))


def test_a_run_with_its_own_search_takes_no_batch(processes, random_bundle):
    processes.coordinator("--bundle", random_bundle.path, "--task", tasks.TOY)
    with scorer(processes) as search, pytest.raises(BatchError, match="--optimiser"):
        search.submit(vectors(1))


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
