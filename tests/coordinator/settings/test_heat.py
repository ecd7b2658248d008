"""A run whose temperature is raised, against its journal, without a transport."""

import argparse
import io
import random
from dataclasses import replace

import pytest
from rich.console import Console

from dreamfleet.common.monitoring.status_panel import RunPanel
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.service.snapshot import take_snapshot
from dreamfleet.coordinator.settings.config import LimitsConfig
from dreamfleet.coordinator.verbs import fork
from tests.coordinator.evaluated import EVERY, Evaluated
from tests.coordinator.run.test_run import SETTINGS
from tests.support.samples import SPEC

GENERATIONS = 14
HEATED = replace(
    SETTINGS, task=replace(SPEC, temperature=1.0), heat=1.5, evaluate_every=EVERY, evaluation_episodes=2,
    population=6, collect_every=0,
)  # fmt: skip
REALITY = (500.0, 400.0, 300.0, 450.0, 350.0, 300.0, 300.0)  # of the means after generations 1, 3, 5, ...
TEMPERATURES = [None] * 6 + [1.5] * 6 + [2.25] * 2


class Heated(Evaluated):
    reality = REALITY

    def outcome(self):
        with RunFolder(self.path) as run:
            numbers = [(number, index) for number in range(GENERATIONS) for index in range(self.settings.population)]
            told = [(run.candidate(*each).tobytes(), run.fitness(*each)) for each in numbers]
            return told, [each for each in run.evaluations() if each.generation % EVERY]


@pytest.fixture
def heated(tmp_path, random_bundle):
    made = []

    def make(name, generations=GENERATIONS):
        made.append(Heated(tmp_path / name, random_bundle.path, HEATED, generations))
        return made[-1]

    yield make
    for each in made:
        each.journal.close()


@pytest.fixture
def undisturbed(heated):
    bench = heated("undisturbed")
    assert [terms[0] for terms in bench.drive(lambda _: 0).values()] == TEMPERATURES
    return bench.outcome()


@pytest.mark.parametrize("seed", range(4))
def test_killed_anywhere_it_raises_at_the_same_generations_and_gives_the_same_bits(heated, undisturbed, seed):
    bench, chance = heated("night"), random.Random(seed)
    bench.die_by(chance)
    found = bench.drive(lambda bench: chance.randrange(len(bench.given)))
    assert [found[number][0] for number in range(GENERATIONS)] == TEMPERATURES
    assert bench.run.incarnation > 10
    assert bench.outcome() == undisturbed


def test_a_run_that_ended_between_two_checks_and_goes_on_raises_as_if_it_had_not(heated, undisturbed):
    bench = heated("night", generations=5)
    bench.drive(lambda _: 0)
    bench.limits = LimitsConfig(generations=GENERATIONS)
    bench.restart()
    bench.drive(lambda _: 0)
    assert bench.outcome() == undisturbed


def test_a_generation_waits_for_the_check_that_decides_its_temperature_and_for_no_other(heated, undisturbed):
    bench = heated("night")
    waited = []
    while bench.run.ended is None:
        bench.fetch()
        scored = bench.first("score")
        if scored is None and bench.run.generation.complete:
            assert bench.run.fleet.drain_background, "every slot may drive the check"
            waited.append((bench.run.generation.number, {job.generation for job in bench.given}))
        bench.finish(0 if scored is None else scored)
    assert waited[::2] == [(number, {number - EVERY}) for number in range(3, GENERATIONS, EVERY)]
    assert bench.outcome() == undisturbed


def test_the_temperature_is_told_as_it_rises(heated):
    bench, told = heated("night"), []
    bench.drive(lambda _: 0, lambda: told.append(take_snapshot(bench.run, "night", {}, 0.0, 0.0)))
    assert {each.status.generation.temperature for each in told} == {1.0, 1.5, 2.25}
    console = Console(file=io.StringIO(), width=120)
    console.print(RunPanel(told[-1].status))
    assert "temperature 2.25" in console.file.getvalue()
    notes = [note for note in bench.run.fleet.notes if "dreams at" in note]
    assert notes == [
        f"generation {number} dreams at temperature {each}: the evaluated mean fell"
        for number, each in ((6, 1.5), (12, 2.25))
    ]


def test_a_fork_begins_as_warm_as_its_run_is(heated, monkeypatch):
    bench, served = heated("night", generations=7), []
    bench.drive(lambda _: 0)
    monkeypatch.setattr(
        "dreamfleet.coordinator.verbs.coordinator.serve_new_run", lambda _args, settings, *_: served.append(settings)
    )
    fork.run(argparse.Namespace(source="night", runs_dir=bench.path.parent, run_name=None, given=frozenset()))
    assert [(each["temperature"], each["heat"]) for each in served] == [(1.5, 1.5)]
