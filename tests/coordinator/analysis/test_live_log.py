"""A run's curves in the records of other programs, as its journal has them.
Tests sinks.py, coordinator/settings/live_log.py and common/files/tensorboard.py."""

import sqlite3
from collections import Counter
from contextlib import closing
from multiprocessing import active_children

import pytest

from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.tensorboard import EVENTS, read_scalars
from dreamfleet.common.host.packages import hidden
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.analysis.export import scalars_of
from dreamfleet.coordinator.analysis.live_log import follow, live_log
from dreamfleet.coordinator.analysis.sinks import open_sink
from dreamfleet.coordinator.settings.live_log import SinkName, check_sinks, parse_sink
from dreamfleet.coordinator.settings.network import NetworkConfig
from tests.support.events import scalars

RUN = "dream"
BOARD = SinkName("tensorboard", "")


def wanted(run):
    """Every point of the journal."""
    with RunFolder(run) as stored:
        return Counter((name.replace("__", "/"), step) for step, each in scalars_of(stored) for name in each)


def drawn(folder):
    return Counter((name, step) for name, points in scalars(folder).items() for step, _ in points)


def write(run, name=BOARD, looks=1, between=lambda look: None):
    """Follow a run for so many looks; what was reported."""
    done, said = iter(range(1, looks + 1)), []

    def is_over():
        look = next(done)
        between(look)
        return look == looks

    follow(run, name, is_over, said.append)
    return said


def delete_from(run, generation):
    with closing(sqlite3.connect(run / "journal.sqlite")) as journal, journal:
        journal.execute("UPDATE generation SET closed = NULL WHERE number >= ?", (generation,))


def test_a_record_has_every_point_once(runs):
    assert write(runs / RUN, looks=3) == []
    assert drawn(runs / RUN / "tensorboard") == wanted(runs / RUN)
    assert max(drawn(runs / RUN / "tensorboard").values()) == 1


def test_another_run_of_the_same_name_keeps_its_record(runs, tmp_path):
    name = SinkName("tensorboard", str(tmp_path / "board"))
    assert write(runs / RUN, name) == []
    before = drawn(tmp_path / "board" / RUN)
    with closing(sqlite3.connect(runs / RUN / "journal.sqlite")) as journal, journal:
        journal.execute("UPDATE run SET value = 'another' WHERE key = 'uid'")
    (said,) = write(runs / RUN, name)
    assert "holds the curves of another run of this name" in said
    assert drawn(tmp_path / "board" / RUN) == before


def test_a_process_that_was_killed_holds_up_no_end(runs, caplog):
    with live_log(runs / RUN, ("tensorboard",)):
        (child,) = active_children()
        child.kill()
        child.join()
    assert not active_children()


def test_a_record_goes_on_where_it_was_left(runs, tmp_path):
    name = SinkName("tensorboard", str(tmp_path / "board"))
    whole = wanted(runs / RUN)
    with closing(sqlite3.connect(runs / RUN / "journal.sqlite")) as journal, journal:
        (times,) = [dict(journal.execute("SELECT number, closed FROM generation"))]
    delete_from(runs / RUN, 2)
    write(runs / RUN, name)
    (first,) = (tmp_path / "board" / RUN).glob(EVENTS)
    first.write_bytes(first.read_bytes()[:-5])  # a kill tore the last record
    with closing(sqlite3.connect(runs / RUN / "journal.sqlite")) as journal, journal:
        journal.executemany("UPDATE generation SET closed = ? WHERE number = ?", [(at, n) for n, at in times.items()])
    write(runs / RUN, name)
    write(runs / RUN, name)
    found = read_scalars(tmp_path / "board" / RUN)
    assert Counter((each, step) for each, points in found.items() for step in points) == whole
    assert sum(len(path.read_bytes()) > 0 for path in (tmp_path / "board" / RUN).glob(EVENTS)) == 3


def test_results_that_were_taken_back_are_replaced(runs):
    folder = runs / RUN / "tensorboard"
    write(runs / RUN)
    before = read_scalars(folder)
    with closing(sqlite3.connect(runs / RUN / "journal.sqlite")) as journal, journal:
        journal.execute("UPDATE generation SET mean = mean + 100 WHERE number = 1")
    write(runs / RUN)
    found = read_scalars(folder)
    assert found["fitness/mean"][1] == pytest.approx(before["fitness/mean"][1] + 100)
    assert {name: len(points) for name, points in found.items()} == {name: len(each) for name, each in before.items()}


def test_points_of_generations_that_were_dropped_are_taken_back(runs):
    folder = runs / RUN / "tensorboard"
    write(runs / RUN)
    delete_from(runs / RUN, 1)
    with closing(sqlite3.connect(runs / RUN / "journal.sqlite")) as journal, journal:
        journal.execute("DELETE FROM evaluation WHERE generation >= 1")
        journal.execute("DELETE FROM run WHERE key = 'confirmed'")
    write(runs / RUN)
    assert {(name, step) for name, points in read_scalars(folder).items() for step in points} == set(wanted(runs / RUN))


def test_a_record_that_cannot_be_written_is_reported_once_and_whole_later(runs):
    obstacle = runs / RUN / "tensorboard"
    obstacle.write_text("a file where the folder should be")
    said = write(runs / RUN, looks=4, between=lambda look: obstacle.unlink() if look == 4 else None)
    assert [text.partition(" (")[0] for text in said] == [
        "the curves do not go to tensorboard", "the curves go to tensorboard again, and nothing is missing there",
    ]  # fmt: skip
    assert drawn(obstacle) == wanted(runs / RUN)


def test_a_name_has_a_kind_and_perhaps_a_place():
    assert parse_sink("tensorboard:/tmp/board") == SinkName("tensorboard", "/tmp/board")
    with pytest.raises(UsageError, match="name one of tensorboard, wandb, mlflow"):
        NetworkConfig(log_to=("comet",))
    with pytest.raises(UsageError, match="names a kind twice"):
        NetworkConfig(log_to=("wandb", "wandb:mine"))


@pytest.mark.parametrize("kind", ["wandb", "mlflow"])
def test_a_missing_package_is_one_line(kind):
    with hidden(kind), pytest.raises(UsageError, match=f"pip install {kind}"):
        check_sinks((kind,))


def test_a_run_does_not_begin_without_the_package(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("DREAMFLEET_NETWORK_LOG_TO", "wandb")
    with hidden("wandb"):
        assert main(["coordinator", "--runs-dir", str(tmp_path / "runs")]) == 2
    assert "pip install wandb" in capsys.readouterr().err
    assert not (tmp_path / "runs" / "run").exists()


@pytest.mark.filterwarnings("ignore")  # of its libraries
def test_wandb_has_every_point_once_also_in_a_second_life(runs, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    check_twice(runs, SinkName("wandb", ""))


@pytest.mark.filterwarnings("ignore")  # of its libraries
def test_mlflow_has_every_point_once_also_in_a_second_life(runs, tmp_path):
    pytest.importorskip("mlflow")
    check_twice(runs, SinkName("mlflow", f"sqlite:///{tmp_path}/mlflow.db"))


def check_twice(runs, name):
    delete_from(runs / "reality", 1)
    before = wanted(runs / "reality")
    assert write(runs / "reality", name) == write(runs / "reality", name) == []
    with RunFolder(runs / "reality") as stored:
        sink = open_sink(name, stored)
        found = Counter((each.replace("__", "/"), step) for each, points in sink.known.items() for step in points)
        sink.close()
    assert found == before
