"""Every table of a run has the same candidates, whose effort sums to that of their generations.
Tests common/runs/journal/candidate_counts.py."""

import csv
from collections import Counter
from dataclasses import replace

import pytest
from pyarrow import parquet

from dreamfleet.coordinator.addons.runs.export import export_csv, export_parquet, rows_of
from dreamfleet.coordinator.addons.runs.stored_run import StoredRun
from dreamfleet.coordinator.run.recall import bar_stored
from tests.support.failing_runs import SETTINGS, by_vector

NAMES = "generation", "episodes", "steps"


def by_seed(job):
    return job.kind == "score" and job.seeds[0] % 4 == 0


@pytest.mark.parametrize("is_recalled", [False, True])
@pytest.mark.parametrize(
    ("racing", "on_failure", "fails"),
    [(True, "redraw", by_vector(0.15)), (False, "redraw", by_vector(0.3)), (True, "worst", by_vector(0.15)),
     (False, "worst", by_seed), (True, "redraw", lambda _: False)],
)  # fmt: skip
def test_every_table_has_the_same_candidates(failing, tmp_path, racing, on_failure, fails, is_recalled):
    settings = replace(SETTINGS, racing=racing, episodes=4, on_failure=on_failure)
    bench = failing(fails=fails, limit=1.0, settings=settings)
    if is_recalled:
        bench.run.leave()
        bench.journal.close()
        bar_stored(bench.path, "a", is_barred=True)
    with StoredRun(bench.path) as run:
        rows = [tuple(each[name] for name in NAMES) for each in rows_of(run, "candidates")]
        closed = list(rows_of(run, "generations"))
        pandas, polars = run.to_pandas("candidates"), run.to_polars("candidates")
        export_csv(run, tmp_path)
        export_parquet(run, tmp_path)
    assert list(zip(pandas.generation, pandas.episodes, pandas.steps, strict=True)) == rows
    assert polars.select(NAMES).rows() == rows
    stored = parquet.read_table(tmp_path / "candidates.parquet").to_pylist()
    assert [tuple(each[name] for name in NAMES) for each in stored] == rows
    with (tmp_path / "candidates.csv").open() as file:
        written = [{name: int(row[name]) for name in NAMES} for row in csv.DictReader(file)]
    assert [tuple(row.values()) for row in written] == rows
    assert closed or is_recalled
    effort = Counter()
    for generation, _, steps in rows:
        effort[generation] += steps
    assert [effort[each["number"]] for each in closed] == [each["steps"] for each in closed]
