"""A copy of a run that is being served, from which it goes on to the same bits when its own folder is lost."""

import os
import shlex
import shutil
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest

from dreamfleet.common.addons.evaluation_report import REPORT
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_paths import BUNDLE, JOURNAL, ROLLOUTS, run_command
from dreamfleet.coordinator.addons.runs import backup
from dreamfleet.coordinator.run.recall import bar_stored
from dreamfleet.coordinator.storage.journal import Journal
from tests.support import tasks
from tests.support.journals import change_journal
from tests.support.processes import ROOT, call_here
from tests.support.same_bits import evolve, outcome

FIXTURES = ROOT / "tests" / "fixtures"
GENERATIONS = 4


def back_up(processes, to, name="test", call=call_here):
    return call("runs", "backup", name, "--runs-dir", processes.runs, "--to", to)


@pytest.mark.exact
@pytest.mark.slow
def test_a_run_goes_on_from_a_copy_that_was_made_while_it_was_served(processes, small, random_bundle, tmp_path):
    flags = (*small, "--generations", GENERATIONS, "--collect-every", 1, "--collect-episodes", 1)
    whole, safe = evolve(processes, "whole", 1, *flags, task=tasks.SLOW_TOY), tmp_path / "safe"
    served = processes.coordinator(*flags)
    for generation in (0, 1):
        worker = processes.worker("--run", "test", "--task", tasks.SLOW_TOY)
        served.wait_for_event("generation", number=generation)
        worker.end()  # the run goes no further while it is copied
        code, out, err = back_up(processes, safe)
        assert code == 0, err
        assert "--resume test" in out
    served.popen.kill()
    shutil.rmtree(processes.runs / "test")
    assert [path.name for path in safe.iterdir()] == ["test"], "the earlier copy is gone"
    assert (safe / "test" / BUNDLE).read_bytes() == random_bundle.path.read_bytes()
    with open_run(safe, "test") as copy:
        assert 2 <= len(copy.history()) < GENERATIONS
        assert all(path.is_file() for path in copy.rollouts())

    processes.printed("runs", "backup", "test", "--runs-dir", safe, "--to", processes.runs)
    resumed = processes.resume()
    processes.worker("--run", "test", "--task", tasks.SLOW_TOY)
    assert resumed.finish()[0] == 0
    assert outcome(processes, "test") == whole
    assert len(list((processes.runs / "test" / ROLLOUTS).iterdir())) == GENERATIONS

    back = call_here("runs", "backup", "test", "--runs-dir", safe, "--to", processes.runs)
    assert back[0] == 2, "what was continued is ahead"
    assert outcome(processes, "test") == whole
    assert back_up(processes, safe)[0] == 0


@pytest.fixture
def finished(processes):
    """A recorded run of twelve generations."""
    shutil.copytree(FIXTURES / "runs" / "dream", processes.runs / "test")
    shutil.copyfile(FIXTURES / "small.zip", processes.runs / "test" / BUNDLE)
    return processes


@pytest.fixture
def safe(finished, tmp_path):
    """The folder of a copy of it."""
    assert back_up(finished, tmp_path / "safe")[0] == 0
    return tmp_path / "safe"


def test_the_command_that_continues_the_copy_holds_in_any_folder(finished, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = back_up(finished, "safe")
    assert code == 0, err
    words = shlex.split(out)
    assert words[words.index("--runs-dir") + 1] == str(tmp_path / "safe")


def test_an_evaluation_goes_along_and_back_and_one_that_only_the_copy_has_stays(finished, safe):
    source, copy = (folder / "test" / REPORT for folder in (finished.runs, safe))
    assert not copy.exists()
    copy.write_text("of the copy")
    assert back_up(finished, safe)[0] == 0
    assert copy.read_text() == "of the copy"
    source.write_text("of the run")
    assert back_up(finished, safe)[0] == 0
    assert copy.read_text() == "of the run"
    shutil.rmtree(source.parent)
    assert call_here("runs", "backup", "test", "--runs-dir", safe, "--to", finished.runs)[0] == 0
    assert source.read_text() == "of the run"
    source.unlink()
    os.mkfifo(source)  # what is no file hinders no copy
    assert back_up(finished, safe)[0] == 0


def test_what_cannot_be_a_copy_is_left_alone(finished, tmp_path):
    other = tmp_path / "other"
    for wrong in (finished.runs, tmp_path / "taken", other):
        if wrong.name == "taken":
            (wrong / "test").mkdir(parents=True)
        elif wrong == other:
            assert back_up(finished, other)[0] == 0
            change_journal(other / "test", "UPDATE run SET value = 'another' WHERE key = 'uid'")
            change_journal(other / "test", "DELETE FROM run WHERE key = 'checksum'")
        code, _, err = back_up(finished, wrong)
        assert (code, str(wrong / "test") in err) == (2, True), err
    code, _, err = back_up(finished, "/proc/nowhere")
    assert (code, "/proc/nowhere" in err) == (1, True), err
    code, _, err = back_up(finished, tmp_path, name="nobody")
    assert (code, "'nobody'" in err) == (1, True), err


def begin_again(folder):
    """What each coordinator that resumes a run writes first."""
    with closing(Journal(folder / JOURNAL)) as journal:
        journal.begin_incarnation()
        journal.commit()


def forget_old_events(folder):
    """What a coordinator does whose run has many."""
    begin_again(folder)
    change_journal(folder, "DELETE FROM event WHERE number < (SELECT max(number) FROM event)")


ADDED = {
    "event": "1, 0.0, 1, 'incarnation 1 begins', '', ''",
    "result": "randomblob(32), kind, generation, candidate, episode, seed, fitness, steps, seconds, worker, "
    "fingerprint, incarnation, host_class, measures FROM result",
    "batch": "1, 'sent', x'', '[]', 0, NULL, 0.0, NULL, 'waiting', '{}'",
}


@pytest.mark.parametrize("ahead", [*ADDED, "copy", "both", "barred"])
def test_a_copy_that_holds_what_its_run_does_not_is_kept(finished, safe, ahead):
    """Also where both were continued, and where a damaged log took the run's own last results."""
    source, copy = finished.runs / "test", safe / "test"
    if ahead in ADDED:
        change_journal(copy, f"INSERT INTO {ahead} SELECT {ADDED[ahead]} LIMIT 1")
    elif ahead == "barred":
        bar_stored(copy, "vm", is_barred=True)
    else:
        for each in (copy, source)[: 1 + (ahead == "both")]:
            begin_again(each)
    kept = (copy / JOURNAL).read_bytes()
    code, _, err = back_up(finished, safe)
    assert code == 2
    for part in (str(copy), str(source), run_command(copy, "runs", "delete")):
        assert part in err
    assert [path.name for path in safe.iterdir()] == ["test"]
    assert (copy / JOURNAL).read_bytes() == kept


@pytest.mark.parametrize("change", [begin_again, forget_old_events, partial(bar_stored, host="vm", is_barred=True)])
def test_a_copy_that_is_behind_is_replaced_and_then_is_no_copy_to_go_back_from(finished, safe, change):
    source, copy = finished.runs / "test", safe / "test"
    change(source)
    assert call_here("runs", "backup", "test", "--runs-dir", safe, "--to", finished.runs)[0] == 2
    assert back_up(finished, safe)[0] == 0
    with open_run(finished.runs, "test") as run, open_run(safe, "test") as copied:
        assert copied.events() == run.events()
        assert copied.result_count() == run.result_count()
    change_journal(copy, "PRAGMA journal_mode = WAL")  # as where somebody continues it
    assert call_here("runs", "backup", "test", "--runs-dir", safe, "--to", finished.runs)[0] == 0, "both are equal"


def test_a_copy_that_cannot_be_compared_is_kept(finished, safe):
    with (safe / "test" / JOURNAL).open("r+b") as file:
        file.seek(8192)
        file.write(bytes(200_000))
    code, _, err = back_up(finished, safe)
    assert (code, str(safe / "test") in err, (safe / "test" / JOURNAL).exists()) == (1, True, True), err


def test_a_call_that_was_killed_between_two_names_is_made_good(finished, safe):
    (safe / "test").rename(safe / ".test.former")
    (safe / ".test.part").mkdir()
    code, _, err = back_up(finished, safe)
    assert code == 0, err
    assert [path.name for path in safe.iterdir()] == ["test"]


def test_a_call_that_is_interrupted_leaves_the_earlier_copy(finished, safe, monkeypatch):
    rename = Path.rename

    def interrupted(self, target):
        if self.name == ".test.part":
            raise KeyboardInterrupt
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", interrupted)
    with open_run(finished.runs, "test") as source, pytest.raises(KeyboardInterrupt):
        backup.back_up(source, safe / "test")
    assert [path.name for path in safe.iterdir()] == ["test"]
    with open_run(safe, "test") as copy:
        assert len(copy.history()) == 12


def test_two_at_once_leave_a_whole_copy(finished, safe, monkeypatch):
    lock, said = backup.run_lock, []

    def meanwhile(target):
        said.append(back_up(finished, safe, call=finished.call))
        return lock(target)

    monkeypatch.setattr(backup, "run_lock", meanwhile)
    with open_run(finished.runs, "test") as source:
        backup.back_up(source, safe / "test")
    assert [code for code, *_ in said] == [2]
    assert [path.name for path in safe.iterdir()] == ["test"]
    with open_run(safe, "test") as copy:
        assert len(copy.history()) == 12


def test_a_link_is_no_copy_to_replace(finished, tmp_path):
    assert back_up(finished, tmp_path / "far")[0] == 0
    (tmp_path / "near").mkdir()
    (tmp_path / "near" / "test").symlink_to(tmp_path / "far" / "test")
    code, _, err = back_up(finished, tmp_path / "near")
    assert (code, str(tmp_path / "near" / "test") in err) == (2, True), err
    assert [path.name for path in (tmp_path / "near").iterdir()] == ["test"]
