"""A run's journal as CSV, Parquet and TensorBoard's events, read back by those who read such files.
Tests backup.py, stored_run.py, common/addons/analysis/scored_history.py and common/runs/journal/candidate_counts.py.
"""

import csv
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from typing import get_args

import pytest
from pyarrow import parquet

from dreamfleet.common.cli import command_line
from dreamfleet.common.errors import BundleError, ControllerError, MissingExtraError, UsageError
from dreamfleet.common.host.processes import command
from dreamfleet.common.runs.run_folder import CONFIRMED, RunFolder
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.coordinator.addons.runs import backup
from dreamfleet.coordinator.addons.runs.export import ELITES, TABLES, export_csv, export_parquet, export_tensorboard
from dreamfleet.coordinator.addons.runs.plot import KINDS, fitness_figure, save_figure
from dreamfleet.coordinator.addons.runs.stored_run import TableName, open_run
from dreamfleet.coordinator.run.recall import bar_stored
from dreamfleet.experiments.verbs.compare import SAME_SEEDS
from tests.support.disks import small_disk
from tests.support.events import scalars
from tests.support.failing_runs import SETTINGS, finished
from tests.support.journals import change_journal, change_settings, confirm
from tests.support.processes import DEADLINE, call_here, environment, printed
from tests.support.tables import cells


@pytest.fixture
def export(runs, tmp_path):
    """Export a recorded run; the folder with its files."""

    def export(kind):
        printed("runs", "export", "reality", f"--{kind}", "--out", tmp_path / kind)
        return tmp_path / kind

    return export


@pytest.fixture
def stored(runs):
    with RunFolder(runs / "reality") as run:
        return run.history(), run.candidates(), run.evaluations()


def read_csv(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def test_csv_tables_hold_every_row_of_the_journal(export, stored):
    history, candidates, evaluations = stored
    read = {path.name: read_csv(path) for path in export("csv").iterdir()}
    assert read.keys() == {"candidates.csv", "evaluations.csv", "generations.csv"}
    assert [float(row["mean"]) for row in read["generations.csv"]] == [each.mean for each in history]
    assert [(int(row["generation"]), int(row["number"])) for row in read["candidates.csv"]] == [
        (each.generation, each.number) for each in candidates
    ]
    assert [float(row["error"]) for row in read["evaluations.csv"]] == [each.error for each in evaluations]


def test_a_generation_without_a_fitness_has_none_in_any_export(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(RunFolder, "unscored_generations", lambda _: {1})
    with RunFolder(runs / "reality") as run:
        for write in (export_csv, export_parquet, export_tensorboard):
            write(run, tmp_path)
    fitness, drawn = ("mean", "std", "best", "worst"), scalars(tmp_path)
    assert [read_csv(tmp_path / "generations.csv")[1][name] for name in fitness] == [""] * 4
    assert [parquet.read_table(tmp_path / "generations.parquet").to_pylist()[1][name] for name in fitness] == [None] * 4
    assert 1 not in dict(drawn["fitness/best"])
    assert 1 in dict(drawn["search/sigma"])


def test_the_name_of_a_measure_is_no_formula_in_a_spreadsheet(runs, tmp_path):
    change_settings(runs / "reality", lambda settings: replace(settings, archive=("@SUM(1+1)=0:1:2",)))
    change_journal(runs / "reality", "UPDATE candidate SET measures = '[0.5]'")
    with RunFolder(runs / "reality") as run:
        export_csv(run, tmp_path)
    with (tmp_path / "elites.csv").open(newline="") as file:
        names, first, *_ = csv.reader(file)
    assert names == ["cell.@SUM(1+1)", "'@SUM(1+1)", "fitness", "generation", "candidate"]
    assert float(first[1]) == 0.5


@pytest.mark.parametrize("name", ["elites.csv", "elites.npz"])
def test_files_of_others_are_neither_removed_nor_taken_for_its_own(runs, tmp_path, name):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text("mine")
    with RunFolder(runs / "reality") as run, pytest.raises(UsageError, match=name):
        export_csv(run, tmp_path / "out")
    assert [each.name for each in (tmp_path / "out").iterdir()] == [name]


def test_candidates_have_their_episodes_and_effort(runs, stored):
    history, candidates, _ = stored
    first = [each for each in candidates if each.generation == 0]
    assert sum(each.fitness for each in first) / len(first) == pytest.approx(history[0].mean)
    assert sum(each.steps for each in first) == history[0].steps
    with RunFolder(runs / "reality") as run:
        assert first[0].episodes == len(run.results(0, 0))


def test_parquet_tables_have_types(export, stored):
    history, candidates, _ = stored
    out = export("parquet")
    table = parquet.read_table(out / "generations.parquet")
    assert table.column("mean").to_pylist() == [each.mean for each in history]
    assert str(table.schema.field("number").type) == "int64"
    assert parquet.read_table(out / "candidates.parquet").num_rows == len(candidates)


def test_tensorboard_gets_a_curve_a_figure_and_no_second_one(export, stored):
    history, _, evaluations = stored
    out = export("tensorboard")
    found = scalars(out)
    assert found["fitness/mean"] == [(each.number, pytest.approx(each.mean)) for each in history]
    assert [step for step, _ in found["score/evaluated"]] == [each.generation for each in evaluations]
    code, _, error = call_here("runs", "export", "reality", "--tensorboard", "--out", out)
    assert (code, "--out" in error) == (2, True)


@pytest.mark.parametrize(
    ("kind", "module"), [("parquet", "pyarrow"), ("tensorboard", "tensorboardX.event_file_writer")]
)
def test_a_missing_package_names_the_extra(runs, tmp_path, monkeypatch, kind, module):
    monkeypatch.setitem(sys.modules, module, None)
    code, _, error = call_here("runs", "export", "reality", f"--{kind}", "--out", tmp_path / "out")
    assert (code, error.count("\n")) == (1, 1)
    assert "pip install 'dreamfleet[export]'" in error


def test_an_evaluation_of_one_episode_has_no_error_in_any_export_or_view(runs, export, tmp_path):
    change_journal(runs / "reality", "UPDATE evaluation SET episodes = 1, std = 0")
    assert {row["error"] for row in read_csv(export("csv") / "evaluations.csv")} == {""}
    table = parquet.read_table(export("parquet") / "evaluations.parquet")
    assert set(table.column("error").to_pylist()) == {None}
    curves = scalars(export("tensorboard"))
    assert "score/evaluated" in curves
    assert "score/evaluated_error" not in curves
    shutil.copytree(runs / "reality", runs / "other")
    text = printed("runs", "show", "reality") + printed("compare", "reality", "other")
    assert "±" not in text.replace(SAME_SEEDS, "")
    document = json.loads(printed("runs", "show", "reality", "--json"))
    assert {each["error"] for each in document["evaluations"]} == {None}
    for names in (["reality"], ["reality", "other"]):
        printed("runs", "plot", *names, "--out", tmp_path / "a.svg")


@pytest.mark.parametrize("write", [export_csv, export_parquet])
def test_no_table_of_an_earlier_export_stands_among_those_of_a_later_one(runs, tmp_path, write):
    """A recall can take a run's confirmation."""
    confirm(runs / "reality", 1, 4, 1.0, 1.0, 999)
    with RunFolder(runs / "reality") as run:
        write(run, tmp_path)
    change_journal(runs / "reality", "DELETE FROM run WHERE key = ?", CONFIRMED)
    with RunFolder(runs / "reality") as run, pytest.raises(UsageError, match="confirmation"):
        write(run, tmp_path)


@pytest.mark.slow
def test_events_onto_a_full_disk_end_with_one_line_and_leave_nothing(runs, tmp_path):
    with small_disk(tmp_path / "disk", 1) as disk:
        if disk is None:
            pytest.skip("no disk can be mounted here")
        out = disk.path / "out"
        out.mkdir()
        disk.fill()
        words = ["runs", "export", "reality", "--tensorboard", "--out", str(out), "--runs-dir", str(runs)]
        done = subprocess.run(command(*words), capture_output=True, text=True, timeout=DEADLINE, check=False)
        assert (done.returncode, done.stderr.count("\n")) == (1, 1), done.stderr
        assert "No space left on device" in done.stderr
        disk.free()
        assert not list(out.iterdir())
        assert command_line.main(words) == 0


def test_a_generation_without_a_mean_is_shown_as_a_dash(runs):
    query = "UPDATE generation SET mean = NULL, std = NULL, best = NULL, worst = NULL WHERE number = 1"
    change_journal(runs / "reality", query)
    rows = [cells(line) for line in printed("runs", "show", "reality").splitlines()]
    shown = {row[0]: row[1:5] for row in rows if len(row) > 5}
    assert shown["1"] == ["-"] * 4
    assert "-" not in shown["0"]
    history = json.loads(printed("runs", "show", "reality", "--json"))["history"]
    assert [each["mean"] is None for each in history][:2] == [False, True]


def test_a_copy_during_which_results_are_recalled_has_no_controller_of_theirs(tmp_path, random_bundle, monkeypatch):
    bench = finished(tmp_path, random_bundle, SETTINGS, fails=lambda job: False)
    bench.journal.close()
    assert (bench.path / CONTROLLER).exists()
    copies, copy_journal = [], backup._copy_journal

    def recalled_meanwhile(source, path):
        if not copies:
            bar_stored(bench.path, "a", is_barred=True)
        copies.append(path)
        copy_journal(source, path)

    monkeypatch.setattr(backup, "_copy_journal", recalled_meanwhile)
    with RunFolder(bench.path) as source:
        backup.back_up(source, tmp_path / "safe" / bench.path.name)
    assert len(copies) == 2
    with RunFolder(tmp_path / "safe" / bench.path.name) as copy:
        assert copy.checks.barred == ("a",)
        assert not copy.controller_path.exists()


def test_no_copy_is_made_inside_the_run(tmp_path, random_bundle):
    bench = finished(tmp_path, random_bundle, SETTINGS, fails=lambda job: False)
    with RunFolder(bench.path) as source, pytest.raises(UsageError):
        backup.back_up(source, bench.path / bench.path.name)
    assert not (bench.path / bench.path.name).exists()


@pytest.fixture
def reality(runs):
    with open_run("reality") as run:
        yield run


@pytest.mark.parametrize("package", ["pandas", "polars"])
def test_tables_are_data_frames(reality, package):
    pytest.importorskip(package)
    frame = getattr(reality, f"to_{package}")
    history, scores = reality.history(), reality.evaluations()
    assert list(frame()["mean"]) == [each.mean for each in history]
    assert list(frame("evaluations")["error"]) == [each.error for each in scores]
    assert len(frame("candidates")) == len(reality.candidates())
    assert list(frame("candidates").columns)[:3] == ["generation", "number", "fitness"]
    assert len(frame("confirmation")) == 0  # its columns are there
    assert "mean" in frame("confirmation").columns


def test_a_wrong_table_names_those_that_there_are(reality):
    with pytest.raises(UsageError, match="generations, candidates, evaluations, confirmation"):
        reality.to_pandas("candidate")
    with pytest.raises(UsageError, match="--archive"):
        reality.to_pandas("elites")


@pytest.mark.parametrize(
    ("call", "package", "remedy"),
    [("to_pandas", "pandas", "pip install pandas"), ("to_polars", "polars", "pip install polars"),
     ("plot", "matplotlib", r"pip install 'dreamfleet\[views\]'")],
)  # fmt: skip
def test_without_the_package_the_error_names_what_to_install(reality, monkeypatch, call, package, remedy):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=f"{package!r}.*{remedy}"):
        getattr(reality, call)()


@pytest.mark.parametrize("kind", ["fitness", "learning"])
def test_it_plots_what_the_verb_plots(reality, tmp_path, kind):
    printed("runs", "plot", "reality", "--kind", kind, "--out", tmp_path / "verb.png")
    reality.plot(kind).savefig(tmp_path / "own.png", dpi=120)
    assert (tmp_path / "verb.png").read_bytes() == (tmp_path / "own.png").read_bytes()


def test_a_run_without_evaluations_has_its_fitness_plotted(runs, tmp_path):
    with open_run("hidden") as run:
        assert run.plot().axes[0].get_ylabel()
        with pytest.raises(UsageError, match="--evaluate-every"):
            run.plot("learning")
        with pytest.raises(UsageError, match=r"archive.*'curve'"):
            run.plot("curve")
        save_figure(fitness_figure(run), tmp_path / f"own{KINDS[1]}")


SHOWN = """
import dreamfleet, sys
from IPython.core.formatters import DisplayFormatter
run = dreamfleet.open_run('reality')
for kind in ('fitness', 'learning'):
    shown, _ = DisplayFormatter().format(run.plot(kind))
    assert shown['image/png'].startswith(b'\\x89PNG'), (kind, shown.keys())
assert 'matplotlib.pyplot' not in sys.modules
"""


def test_a_fresh_notebook_shows_plots(runs, tmp_path):
    pytest.importorskip("IPython")
    subprocess.run([sys.executable, "-c", SHOWN], env=environment(tmp_path), check=True, timeout=DEADLINE)


def test_the_names_of_tables_are_known_to_type_checkers():
    assert get_args(TableName) == (*TABLES, ELITES)


def test_its_controller_and_world_model_are_those_of_its_folder(reality):
    assert reality.controller().bundle == reality.bundle().sha256
    reality.bundle_path.unlink()
    with pytest.raises(BundleError, match="bundle"):
        reality.bundle()
    reality.controller_path.unlink()
    with pytest.raises(ControllerError, match="reality"):
        reality.controller()
