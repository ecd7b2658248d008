"""A run's curves in the records of other programs, as its journal has them.
Tests sinks.py, coordinator/settings/live_log.py and common/files/tensorboard.py."""

import json
import sys
from collections import Counter
from multiprocessing import active_children

import pytest

from dreamfleet.common.cli.command_line import main
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.tensorboard import EVENTS
from dreamfleet.common.host.packages import hidden
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.addons.runs.export import scalars_of
from dreamfleet.coordinator.addons.sinks.live_log import follow, live_log
from dreamfleet.coordinator.addons.sinks.sinks import check_sinks, read_scalars
from dreamfleet.coordinator.settings.live_log import SinkName, parse_sink
from dreamfleet.coordinator.settings.network import NetworkConfig
from tests.support.events import scalars
from tests.support.journals import change_journal
from tests.support.processes import ROOT

EXAMPLES = ROOT / "docs" / "how-to"
BOARD = SinkName("tensorboard", "")


@pytest.fixture
def run(runs):
    return runs / "dream"


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


def test_a_record_has_every_point_once(run):
    assert write(run, looks=3) == []
    assert drawn(run / "tensorboard") == wanted(run)
    assert max(wanted(run).values()) == 1


def test_another_run_of_the_same_name_keeps_its_record(run, tmp_path):
    name, board = SinkName("tensorboard", str(tmp_path / "board")), tmp_path / "board" / run.name
    assert write(run, name) == []
    before = drawn(board)
    change_journal(run, "UPDATE run SET value = 'another' WHERE key = 'uid'")
    (said,) = write(run, name)
    assert str(board) in said
    assert drawn(board) == before


def test_a_process_that_was_killed_holds_up_no_end(run):
    with live_log(run, ("tensorboard",)):
        (child,) = active_children()
        child.kill()
        child.join()
    assert not active_children()


def test_a_record_goes_on_where_it_was_left(run):
    board, whole = run / "tensorboard", wanted(run)
    times = change_journal(run, "SELECT closed, number FROM generation")
    change_journal(run, "UPDATE generation SET closed = NULL WHERE number >= 2")
    write(run)
    (first,) = board.glob(EVENTS)
    first.write_bytes(first.read_bytes()[:-5])  # a kill tore the last record
    for closed_and_number in times:
        change_journal(run, "UPDATE generation SET closed = ? WHERE number = ?", *closed_and_number)
    for _ in range(2):
        write(run)
    assert Counter((name, step) for name, points in read_scalars(board).items() for step in points) == whole
    assert sum(len(path.read_bytes()) > 0 for path in board.glob(EVENTS)) == 3


def test_results_that_were_taken_back_are_replaced(run):
    write(run)
    before = read_scalars(run / "tensorboard")
    change_journal(run, "UPDATE generation SET mean = mean + 100 WHERE number = 1")
    write(run)
    found = read_scalars(run / "tensorboard")
    assert found["fitness/mean"][1] == pytest.approx(before["fitness/mean"][1] + 100)
    assert {name: len(points) for name, points in found.items()} == {name: len(each) for name, each in before.items()}


def test_points_of_generations_that_were_dropped_are_taken_back(run):
    write(run)
    change_journal(run, "UPDATE generation SET closed = NULL WHERE number >= 1")
    change_journal(run, "DELETE FROM evaluation WHERE generation >= 1")
    change_journal(run, "DELETE FROM run WHERE key = 'confirmed'")
    write(run)
    found = read_scalars(run / "tensorboard")
    assert {(name, step) for name, points in found.items() for step in points} == set(wanted(run))


def test_a_record_that_cannot_be_written_is_reported_once_and_whole_later(run):
    obstacle = run / "tensorboard"
    obstacle.write_text("a file where the folder should be")
    said = write(run, looks=4, between=lambda look: obstacle.unlink() if look == 4 else None)
    assert [str(obstacle) in text for text in said] == [True, False]
    assert drawn(obstacle) == wanted(run)


def test_a_name_has_a_kind_and_perhaps_a_place():
    assert parse_sink("tensorboard:/tmp/board") == SinkName("tensorboard", "/tmp/board")
    assert parse_sink("a.b:Sink") == SinkName("a.b:Sink", "")
    assert parse_sink("a.b:Sink:http://127.0.0.1:5000") == SinkName("a.b:Sink", "http://127.0.0.1:5000")
    for wrong in ("comet", "comet:", ":Sink", "a..b:Sink", "../a:Sink", "a:Sink/../b"):
        with pytest.raises(UsageError):
            NetworkConfig(log_to=(wrong,))
    for twice in ("tensorboard", "a:Sink"):
        with pytest.raises(UsageError):
            NetworkConfig(log_to=(twice, f"{twice}:mine"))


def test_a_missing_package_is_a_users_error(monkeypatch):
    monkeypatch.delitem(sys.modules, "tensorboardX", raising=False)  # what is loaded cannot be hidden
    with hidden("tensorboardX"), pytest.raises(UsageError):
        check_sinks(("tensorboard",))


@pytest.fixture
def own_sink(tmp_path, monkeypatch):
    """A sink in a module of the user's own, which counts the processes that import it."""
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / "own_sink.py").write_text(OWN)
    monkeypatch.setenv("DREAMFLEET_TRUST", "")
    monkeypatch.syspath_prepend(folder)
    yield folder
    sys.modules.pop("own_sink", None)


OWN = """
from pathlib import Path
from dreamfleet.coordinator.addons.sinks.sinks import TensorBoardSink
with open(Path(__file__).parent / "imported", "a") as file:
    print(file=file)
class Board(TensorBoardSink):
    pass
class Half:
    def log(self, step, numbers):
        pass
"""


def test_a_sink_of_ones_own_has_every_point(run, tmp_path, own_sink, monkeypatch):
    monkeypatch.setenv("DREAMFLEET_TRUST", "own_sink")
    name = f"own_sink:Board:{tmp_path / 'board'}"
    check_sinks([name])
    with live_log(run, [name]):
        pass
    assert drawn(tmp_path / "board" / run.name) == wanted(run)


@pytest.mark.parametrize("kind", ["own_sink:Half", "own_sink:Absent", "own_absent:Sink"])
def test_a_sink_that_cannot_be_is_a_users_error(own_sink, monkeypatch, kind):
    monkeypatch.setenv("DREAMFLEET_TRUST", "own_sink,own_absent")
    with pytest.raises(UsageError):
        check_sinks((kind,))


def test_a_runs_folder_chooses_no_module_and_its_user_does(run, own_sink, monkeypatch, capsys):
    change_journal(run, "REPLACE INTO run VALUES ('network', ?)", json.dumps({"log_to": ["own_sink:Half"]}))
    assert main(["coordinator", "--resume", run.name]) == 2
    assert "--trust own_sink" in capsys.readouterr().err
    assert not (own_sink / "imported").exists()
    monkeypatch.setenv("DREAMFLEET_NETWORK_LOG_TO", "own_sink:Half")
    assert main(["coordinator", "--resume", run.name]) == 2
    assert (own_sink / "imported").exists()


@pytest.mark.parametrize("kind", ["wandb", "mlflow"])
def test_an_example_without_its_package_ends_the_coordinator_before_its_run(kind, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    monkeypatch.setenv("DREAMFLEET_TRUST", "")
    monkeypatch.setenv("DREAMFLEET_NETWORK_LOG_TO", f"{kind}_sink:{kind.capitalize()}Sink")
    with hidden(kind):
        assert main(["coordinator"]) == 2
    assert not (tmp_path / "runs" / "run").exists()
