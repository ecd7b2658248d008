"""Each candidate's episodes and steps in a run's tables, against what its generations and its search say.

The runs are real journals: candidates fail, are drawn anew, get other seeds, race, and are scored again after recalls.

Tests common/runs/journal/candidate_counts.py.
"""

import csv
import random
from collections import Counter, defaultdict
from dataclasses import replace

import pytest

from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.addons.runs.export import export_csv, export_parquet, rows_of
from dreamfleet.coordinator.addons.runs.stored_run import StoredRun
from dreamfleet.coordinator.run.recall import recall
from dreamfleet.coordinator.storage.verification_records import StoredBar
from tests.support import batch_door
from tests.support.failing_runs import SETTINGS

SEEDS = range(6)


def check(path):
    """Compare the candidates with their generations; counts of what happened."""
    with RunFolder(path) as run:
        history, candidates = {each.number: each for each in run.history()}, run.candidates()
        episodes = {number: len(run.training_seeds(number)) for number in history}
        racing = run.settings.racing
        story = Counter(
            redrawn=run._journal.row("SELECT count(*) FROM redraw")[0], reseeds=run.count_reseeds(history.values())
        )
        surplus = run._journal.row("SELECT count(*) FROM result WHERE kind = 'score'")[0]
    found = defaultdict(list)
    for each in candidates:
        found[each.generation].append(each)
        surplus -= each.episodes
    for number, closed in history.items():
        own = found[number]
        assert sum(each.steps for each in own) == closed.steps
        scored = [each for each in own if each.fitness is not None]
        counts = Counter(each.episodes for each in scored)
        if racing:
            assert counts.keys() <= {episodes[number], -(-episodes[number] // 2)}
            assert episodes[number] == 1 or counts[episodes[number]] <= -(-len(own) // 2)
        else:
            assert counts.keys() <= {episodes[number]}
        assert {(each.episodes, each.steps, each.seconds) for each in own if each.fitness is None} <= {(0, 0, 0.0)}
        assert sum(each.fitness for each in scored) / max(len(scored), 1) == pytest.approx(closed.mean)
    return story + Counter(surplus=surplus, generations=len(history))


def drawn(seed):
    """A run's settings, and which of its episodes fail."""
    chance = random.Random(seed)
    settings = replace(
        SETTINGS, episodes=chance.randint(1, 4), racing=chance.random() < 0.5, population=chance.randint(4, 8),
        on_failure=chance.choice(["worst", "redraw", "redraw"]),
    )  # fmt: skip
    bad_seeds, bad_jobs = chance.choice([0.0, 0.2]), chance.choice([0.04, 0.12])

    def fails(job):
        if job.kind != "score":
            return False
        return random.Random(job.seeds[0]).random() < bad_seeds or job.digest[0] < 256 * bad_jobs

    return settings, fails, chance


@pytest.fixture(scope="module")
def stories():
    found = Counter()
    yield found
    if found["runs"] == len(SEEDS):
        assert min(found[each] for each in ("redrawn", "reseeds", "surplus", "recalls")) > 0, found


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_the_sums_over_candidates_are_their_generations(begin, stories, seed):
    settings, fails, chance = drawn(seed)
    bench = begin(fails, settings, limit=1.0)
    recalls = 0
    for _ in range(50):
        until = chance.randint(3, 60)
        bench.serve(stop=lambda run, until=until: run.fleet.counts["accepted"] > until)
        check(bench.path)
        if (bench.run.state.ended and recalls == 2) or bench.run.state.paused:
            break
        if recalls < 2 and chance.random() < 0.4:
            recalls += 1
            recall(bench.journal, settings, {"ab"[recalls - 1]})
            bench.journal.commit()
        bench.restart()
    bench.journal.commit()
    stories.update(check(bench.path), recalls=recalls, runs=1)


def test_every_table_has_the_same_candidates(begin, tmp_path):
    settings, fails, _ = drawn(1)
    bench = begin(fails, settings, limit=1.0)
    bench.serve()
    bench.journal.close()
    with StoredRun(bench.path) as run:
        expected = rows_of(run, "candidates")
        assert run.to_pandas("candidates").steps.sum() == sum(each["steps"] for each in expected)
        assert run.to_polars("candidates")["episodes"].to_list() == [each["episodes"] for each in expected]
        export_csv(run, tmp_path)
        export_parquet(run, tmp_path)
    with (tmp_path / "candidates.csv").open() as file:
        assert [int(row["episodes"]) for row in csv.DictReader(file)] == [each["episodes"] for each in expected]
    parquet = pytest.importorskip("pyarrow.parquet")
    assert parquet.read_table(tmp_path / "candidates.parquet")["steps"].to_pylist() == [
        each["steps"] for each in expected
    ]


def test_batches_of_others_share_results_and_keep_them_after_a_recall(tmp_path):
    door = batch_door.Door(tmp_path / "search")
    door.submit("one", 2, seeds=(1, 2))
    door.submit("again", 3, seeds=(1, 2, 2))
    door.submit("cut", 3, seeds=(5, 6))
    for _ in range(2):
        door.step()
        door.work()
    door.step()
    door.work(3)
    door.query("cancel", id="cut")
    door.step()
    with RunFolder(door.path) as run:
        before = run.candidates(), [each.steps for each in run.history()]
        assert [each.episodes for each in before[0]] == [2, 2, 3, 3, 3, 2, 0, 0]
        assert [sum(each.steps for each in before[0] if each.generation == number) for number in range(3)] == before[1]
    door.journal.verification.bar("a", StoredBar("a test"), 1)
    recall(door.journal, batch_door.SETTINGS, {"a"})
    door.journal.commit()
    with RunFolder(door.path) as run:
        assert (run.candidates(), [each.steps for each in run.history()]) == before
    door.journal.close()
