"""A run's journal as CSV, Parquet and TensorBoard's events, read back by those who read such files."""

import csv
import json
import re
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from pyarrow import parquet

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.cli import command_line
from dreamfleet.common.host.processes import command
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.experiments.verbs.compare import SAME_SEEDS
from tests.support.disks import small_disk
from tests.support.events import scalars
from tests.support.processes import DEADLINE
from tests.support.tables import cells

RUNS = Path(__file__).parents[3] / "fixtures" / "runs"


@pytest.fixture
def runs(tmp_path):
    shutil.copytree(RUNS / "reality", tmp_path / "runs" / "reality")
    return tmp_path / "runs"


def export(runs, tmp_path, kind):
    out = tmp_path / "out"
    assert command_line.main(["runs", "export", "reality", kind, "--out", str(out), "--runs-dir", str(runs)]) == 0
    return out


def stored(runs):
    with open_run(runs, "reality") as run:
        return run.history(), run.candidates(), run.evaluations()


def test_csv_tables_hold_every_row_of_the_journal(runs, tmp_path):
    out = export(runs, tmp_path, "--csv")
    assert sorted(path.name for path in out.iterdir()) == ["candidates.csv", "evaluations.csv", "generations.csv"]
    history, candidates, evaluations = stored(runs)
    read = {path.stem: list(csv.DictReader(path.read_text().splitlines())) for path in out.iterdir()}
    assert [float(row["mean"]) for row in read["generations"]] == [each.mean for each in history]
    assert [(int(row["generation"]), int(row["number"])) for row in read["candidates"]] == [
        (each.generation, each.number) for each in candidates
    ]
    assert [float(row["error"]) for row in read["evaluations"]] == [each.error for each in evaluations]


def test_candidates_are_exported_with_their_episodes_and_effort(runs):
    history, candidates, _ = stored(runs)
    first = [each for each in candidates if each.generation == 0]
    assert sum(each.fitness for each in first) / len(first) == pytest.approx(history[0].mean)
    assert sum(each.steps for each in first) == history[0].steps
    with open_run(runs, "reality") as run:
        assert first[0].episodes == len(run.results(0, 0))


def test_parquet_tables_have_types(runs, tmp_path):
    out = export(runs, tmp_path, "--parquet")
    history, candidates, _ = stored(runs)
    table = parquet.read_table(out / "generations.parquet")
    assert table.column("mean").to_pylist() == [each.mean for each in history]
    assert str(table.schema.field("number").type) == "int64"
    assert parquet.read_table(out / "candidates.parquet").num_rows == len(candidates)


def test_tensorboard_gets_a_curve_a_figure_and_no_second_one(runs, tmp_path, capsys):
    out = export(runs, tmp_path, "--tensorboard")
    found, (history, _, evaluations) = scalars(out), stored(runs)
    assert found["fitness/mean"] == [(each.number, pytest.approx(each.mean)) for each in history]
    assert [step for step, _ in found["score/evaluated"]] == [each.generation for each in evaluations]
    again = ["runs", "export", "reality", "--tensorboard", "--out", str(out), "--runs-dir", str(runs)]
    assert command_line.main(again) == 2
    assert "--out" in capsys.readouterr().err


@pytest.mark.parametrize(("kind", "package"), [("--parquet", "pyarrow"), ("--tensorboard", "tensorboardX")])
def test_a_missing_package_names_the_extra(runs, tmp_path, kind, package):
    words = ["runs", "export", "reality", kind, "--out", str(tmp_path / "out"), "--runs-dir", str(runs)]
    lacking = f"import sys; sys.modules[{package!r}] = None"
    code = f"{lacking}\nfrom dreamfleet.common.cli.command_line import main; sys.exit(main({words!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "pip install 'dreamfleet[export]'" in done.stderr


def test_the_receipt_says_what_a_paper_cites(runs, capsys):
    assert command_line.main(["runs", "receipt", "reality", "--runs-dir", str(runs)]) == 0
    text = capsys.readouterr().out
    with open_run(runs, "reality") as run:
        for part in (run.uid, run.spec.bundle, "dreamfleet verify candidate reality --candidate",
                     "dreamfleet verify run reality ", "@misc{dreamfleet-reality,"):  # fmt: skip
            assert part in text
    assert command_line.main(["runs", "receipt", "reality", "--runs-dir", str(runs), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["receipt"]["generations"] == len(stored(runs)[0])
    assert facts["controller"] in text


def test_the_receipt_of_a_schedule_lists_every_stage(runs, capsys):
    with closing(sqlite3.connect(runs / "reality" / "journal.sqlite")) as journal, journal:
        (text,) = journal.execute("SELECT value FROM run WHERE key = 'settings'").fetchone()
        stages = [{"generations": 1}, {"horizon": 7, "episodes": 3}]
        text = json.dumps({**json.loads(text), "stages": stages})
        journal.execute("UPDATE run SET value = ? WHERE key = 'settings'", (text,))
    journal.close()
    path = runs / "reality" / "controller.npz"
    controller = Controller.load(path)
    provenance = {**controller.provenance, "settings": json.loads(text)}
    replace(controller, provenance=provenance).save(path)
    assert command_line.main(["runs", "receipt", "reality", "--runs-dir", str(runs)]) == 0
    text = capsys.readouterr().out
    assert re.search("- stage 2: .*1.* 7 steps", text)
    assert "sigma0" not in text


def confirm(runs, text):
    with closing(sqlite3.connect(runs / "reality" / "journal.sqlite")) as journal, journal:
        journal.execute("DELETE FROM run WHERE key = 'confirmed'")
        if text:
            journal.execute("INSERT INTO run VALUES ('confirmed', ?)", (text,))
    journal.close()


@pytest.mark.parametrize("kind", ["csv", "parquet", "tensorboard"])
def test_an_evaluation_of_one_episode_has_no_error_in_any_export_or_view(runs, tmp_path, capsys, kind):
    with closing(sqlite3.connect(runs / "reality" / "journal.sqlite")) as journal, journal:
        journal.execute("UPDATE evaluation SET episodes = 1, std = 0")
    out = export(runs, tmp_path, f"--{kind}")
    if kind == "csv":
        rows = list(csv.DictReader((out / "evaluations.csv").read_text().splitlines()))
        assert {row["error"] for row in rows} == {""}
    elif kind == "parquet":
        assert set(parquet.read_table(out / "evaluations.parquet").column("error").to_pylist()) == {None}
    else:
        assert "score/evaluated" in scalars(out)
        assert "score/evaluated_error" not in scalars(out)
    capsys.readouterr()
    shutil.copytree(runs / "reality", runs / "other")
    for verb in (["runs", "show", "reality"], ["compare", "reality", "other"], ["runs", "show", "reality", "--json"]):
        assert command_line.main([*verb, "--runs-dir", str(runs)]) == 0
    told = capsys.readouterr().out
    assert "±" not in told.replace(SAME_SEEDS, "")
    assert {each["error"] for each in json.loads(told[told.index("{\n") :])["evaluations"]} == {None}
    for name in (["reality"], ["reality", "other"]):
        path = tmp_path / f"{len(name)}.svg"
        assert command_line.main(["runs", "plot", *name, "--out", str(path), "--runs-dir", str(runs)]) == 0


def test_no_table_of_an_earlier_export_stands_among_those_of_a_later_one(runs, tmp_path):
    confirm(runs, '{"generation": 1, "episodes": 4, "mean": 1.0, "std": 1.0, "closed": 999}')
    for kind in ("csv", "parquet"):
        out = export(runs, tmp_path, f"--{kind}")
        assert (out / f"confirmation.{kind}").exists()
        (out / "notes.txt").write_text("of somebody's own")
    confirm(runs, None)
    for kind in ("csv", "parquet"):
        out = export(runs, tmp_path, f"--{kind}")
        assert not (out / f"confirmation.{kind}").exists()
    assert (out / "notes.txt").exists()


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


def test_a_generation_without_a_mean_is_shown_as_a_dash(runs, capsys):
    with closing(sqlite3.connect(runs / "reality" / "journal.sqlite")) as journal:
        journal.execute("UPDATE generation SET mean = NULL, std = NULL, best = NULL, worst = NULL WHERE number = 1")
        journal.commit()
    words = ["runs", "show", "reality", "--runs-dir", str(runs)]
    assert command_line.main(words) == 0
    rows = [cells(line) for line in capsys.readouterr().out.splitlines()]
    shown = {row[0]: row[1:5] for row in rows if len(row) > 5}
    assert shown["1"] == ["-"] * 4
    assert "-" not in shown["0"]
    assert command_line.main([*words, "--json"]) == 0
    assert [each["mean"] is None for each in json.loads(capsys.readouterr().out)["history"]][:2] == [False, True]
