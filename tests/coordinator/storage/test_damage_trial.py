"""Copies of real journals, damaged: each figure that a table, a receipt or a continued run takes is equal, or an error.

What is open is not compared: nothing says yet what it should be.

Tests common/runs/journal/journal_check.py.
"""

import csv
import json
import random
import secrets
import shutil
from collections import Counter
from contextlib import closing
from dataclasses import replace

import pytest

from dreamfleet.common.cli import command_line
from dreamfleet.common.errors import DreamfleetError, JournalError
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.common.runs.run_paths import JOURNAL
from dreamfleet.coordinator.addons.runs.backup import back_up
from dreamfleet.coordinator.addons.runs.stored_run import StoredRun
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.storage.journal import Journal
from tests.support.failing_runs import SETTINGS, Failing, by_vector

PAGE = 4096
COPIES, MANY = 10, 120  # of each of two runs
RUN = "night"
TAKERS = "show", "receipt", "export", "resume", "backup", "frames"
BIG = replace(
    SETTINGS, population=16, episodes=8, evaluate_every=1, evaluation_episodes=4, confirm_episodes=4,
    on_failure="redraw",
)  # fmt: skip


@pytest.fixture(scope="module")
def journals(tmp_path_factory, random_bundle):
    """A run that ended in order, and one that was stopped within a generation."""
    found = {}
    for name in ("ended", "stopped"):
        bench = Failing(tmp_path_factory.mktemp(name) / RUN, random_bundle.path, BIG, fails=by_vector(0.05), limit=1.0)
        most = 10**9 if name == "ended" else 400
        bench.serve(stop=lambda run, most=most: run.fleet.counts["accepted"] > most)
        assert (bench.run.state.ended is not None) == (name == "ended")
        bench.journal.end_incarnation()
        bench.journal.commit()
        bench.journal.close()
        assert len(bench.journal.path.read_bytes()) > 20 * PAGE
        found[name] = bench.path
    return found


def damaged(source, whole):
    """Bits flipped, pages swapped or zeroed, or the end lost; and what it was."""
    data, pages = bytearray(whole), len(whole) // PAGE
    kind = source.choice(["flips", "flips", "swapped", "zeroed", "truncated"])
    if kind == "flips":
        for _ in range(source.choice([1, 1, 3, 30])):
            data[source.randrange(len(data))] ^= 1 << source.randrange(8)
    elif kind == "swapped":
        one, other = (each * PAGE for each in source.sample(range(1, pages), 2))
        data[one : one + PAGE], data[other : other + PAGE] = data[other : other + PAGE], data[one : one + PAGE]
    elif kind == "zeroed":
        start = source.randrange(pages) * PAGE
        data[start : start + PAGE] = bytes(PAGE)
    else:
        del data[source.randrange(len(data)) :]
    return kind, bytes(data)


class Answers:
    """What the product answers about a run, each by the name of who takes it."""

    def __init__(self, folder, closed, capsys, *, ended):
        self.folder, self.closed, self.capsys, self.ended = folder, closed, capsys, ended

    def command(self, *words):
        self.capsys.readouterr()
        code = command_line.main(["runs", *words, RUN, "--runs-dir", str(self.folder.parent), "--json"])
        printed = self.capsys.readouterr()
        if code:
            assert len(printed.err.splitlines()) == 1, printed.err
            raise JournalError(printed.err)
        return json.loads(printed.out)

    def show(self):
        found = self.command("show")
        if self.ended:
            return found
        return found["settings"], found["history"], found["evaluations"]

    def receipt(self):
        found = self.command("receipt")
        return found if self.ended else (found["run_uid"], found["settings"], found["score"])

    def export(self):
        out = self.folder.parent / "tables"
        shutil.rmtree(out, ignore_errors=True)
        self.command("export", "--csv", "--out", str(out))
        tables = {each.name: list(csv.DictReader(each.read_text().splitlines())) for each in out.iterdir()}
        tables["candidates.csv"] = [row for row in tables["candidates.csv"] if int(row["generation"]) < self.closed]
        return tables

    def backup(self):
        target = self.folder.parent / "copies" / RUN
        with open_run(self.folder.parent, RUN) as run:
            back_up(run, target)
        return Answers(target, self.closed, self.capsys, ended=self.ended).frames()

    def frames(self):
        """What a program takes as tables."""
        with StoredRun(self.folder) as run:
            tables = [run.to_pandas(each).to_csv() for each in ("generations", "evaluations", "confirmation")]
            return tables, run.settings, run.ended, run.strategy_state()

    def resume(self):
        with open_run(self.folder.parent, RUN) as run, run.verified_transaction():
            settings = run.settings
        with closing(Journal(self.folder / JOURNAL)) as journal:
            run = Run(journal, settings, LimitsConfig(generations=99), NetworkConfig(), 0.0)
            vectors = [each.vector for each in run.generation.work]
            return run.generation.number, vectors, run.history.rows, run.generations.sigma, run.generations.mean

    def of(self, taker):
        try:
            return getattr(self, taker)()
        except DreamfleetError as error:
            return error


class Trial:
    """One run's answers, and those of its damaged copies."""

    def __init__(self, folder, place, capsys, name):
        self.folder, self.place, self.capsys, self.name = folder, place, capsys, name
        self.whole = (folder / JOURNAL).read_bytes()
        with RunFolder(folder) as run:
            self.closed = len(run.history())
        self.counts = Counter()
        self.expected = {taker: self.ask(self.whole, taker) for taker in TAKERS}
        assert not [each for each in self.expected.values() if isinstance(each, Exception)]

    def ask(self, data, taker):
        shutil.rmtree(self.place, ignore_errors=True)
        folder = shutil.copytree(self.folder, self.place / RUN)
        (folder / JOURNAL).write_bytes(data)
        return Answers(folder, self.closed, self.capsys, ended=self.name == "ended").of(taker)

    def damage(self, seed):
        """Damage one copy, and ask everything."""
        kind, data = damaged(random.Random(f"{self.name} {seed}"), self.whole)
        self.counts[kind] += 1
        for taker in TAKERS:
            found = self.ask(data, taker)
            is_error = isinstance(found, DreamfleetError)
            assert is_error or found == self.expected[taker], (self.name, seed, kind, taker)
            self.counts[f"{taker} {'error' if is_error else 'equal'}"] += 1


@pytest.mark.exact
@pytest.mark.slow
@pytest.mark.parametrize("copies", [COPIES, pytest.param(MANY, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", ["ended", "stopped"])
def test_no_figure_of_a_damaged_journal_is_silently_another(journals, tmp_path, capsys, name, copies):
    trial = Trial(journals[name], tmp_path / "copy", capsys, name)
    first = 0 if copies == COPIES else secrets.randbits(30)  # many are other ones each time
    for seed in range(first, first + copies):
        trial.damage(seed)
    assert trial.counts["show error"] > copies // 3
