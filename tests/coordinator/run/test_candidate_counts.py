"""Each candidate's episodes and steps in a run's tables; `Failing.story` compares them with their generations.
Tests common/runs/journal/candidate_counts.py."""

import csv
from dataclasses import replace

import pytest

from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.addons.runs.export import export_csv, export_parquet, rows_of
from dreamfleet.coordinator.addons.runs.stored_run import StoredRun
from dreamfleet.coordinator.run.recall import recall
from dreamfleet.coordinator.storage.verification_records import StoredBar
from tests.support import batch_door
from tests.support.failing_runs import SETTINGS, by_vector


def test_every_table_has_the_same_candidates(failing, tmp_path):
    settings = replace(SETTINGS, racing=True, episodes=4, on_failure="redraw")
    bench = failing(fails=by_vector(0.15), limit=1.0, settings=settings)
    with StoredRun(bench.path) as run:
        rows = [(each["episodes"], each["steps"]) for each in rows_of(run, "candidates")]
        pandas, polars = run.to_pandas("candidates"), run.to_polars("candidates")
        export_csv(run, tmp_path)
        export_parquet(run, tmp_path)
    assert list(zip(pandas.episodes, pandas.steps, strict=True)) == rows
    assert polars.select("episodes", "steps").rows() == rows
    with (tmp_path / "candidates.csv").open() as file:
        assert [(int(row["episodes"]), int(row["steps"])) for row in csv.DictReader(file)] == rows
    stored = pytest.importorskip("pyarrow.parquet").read_table(tmp_path / "candidates.parquet").to_pylist()
    assert [(each["episodes"], each["steps"]) for each in stored] == rows


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
