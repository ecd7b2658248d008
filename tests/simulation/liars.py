"""Plays with hosts that give other results than they computed: how soon they are barred, and what is left of them.

python -m tests.simulation.liars --plays 20 --share 0.1
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

from dreamfleet.common.protocol.messages import Job
from tests.simulation.coordinator import simulated_surroundings
from tests.simulation.disk import Disk
from tests.simulation.schedule import Fault, Schedule, Shape, draw
from tests.simulation.truth import fitness_of_job
from tests.simulation.violation import Violation
from tests.simulation.witness import Witness
from tests.simulation.world import World, _playing

Lie = Callable[[Job, float], float]


class LenientWitness(Witness):
    """Believes what is written while liars are about, and compares everything with the truth at the end."""

    def _ignored(self, *_: object) -> None:
        """It may be a lie, or follow from one."""

    opened = counted = check_fitness = evaluated = _ignored

    def finished(self, disk: Disk) -> None:
        """What counts is true, whoever lied."""
        for digest, fitness in disk.read("SELECT digest, fitness FROM result"):
            super().counted(disk.jobs[digest], fitness)
        for number, closed in disk.read("SELECT number, closed FROM generation ORDER BY 1"):
            query = "SELECT vector, fitness FROM candidate WHERE generation = ? ORDER BY number"
            vectors, fitness = zip(*disk.read(query, number), strict=True)
            super().opened(number, vectors)
            if closed is not None:
                super().check_fitness(number, list(fitness))
        super().finished(disk)


def by_chance(rate: float, host: int) -> Lie:
    """Changes this share of a host's results, the same ones each time, in the host's own way.

    Two that add the same to one result would confirm each other.
    """

    def lie(job: Job, fitness: float) -> float:
        drawn = hashlib.blake2b(job.digest + str(host).encode(), digest_size=4).digest()
        return fitness + 0.5 + host if int.from_bytes(drawn, "little") < rate * 2**32 else fitness

    return lie


def for_a_candidate(rate: float, population: int, host: int) -> Lie:
    """Praises the first candidates of each generation, as many as are this share of the population.

    Each host in its own way: two that praise equally would confirm each other.
    """
    praised = max(1, round(rate * population))
    return lambda job, fitness: fitness + 10.0 + host if job.kind == "score" and job.candidate < praised else fitness


def one_flip(at: int) -> Lie:
    """Flips the lowest bit of one result, the `at`-th: memory that fails once."""
    seen = Counter[str]()

    def lie(_job: Job, fitness: float) -> float:
        seen["results"] += 1
        return fitness + 2**-52 * (seen["results"] == at)

    return lie


@dataclass(frozen=True)
class Found:
    """What became of one play with liars."""

    liars: frozenset[str]
    barred: frozenset[str]
    brought: dict[str, int]  # results of each barred host that had counted
    forged: dict[str, int]  # of these, those that were changed
    recalled: int
    checked: int
    counted: int
    scored: float  # episodes that slots made
    is_honest: bool  # whether the run has the bits of an honest one


def play_with(
    schedule: Schedule, lies: dict[int, Lie], trusted: frozenset[int] = frozenset(),
    classes: dict[int, str] | None = None, bars: dict[int, float] | None = None,
    seats: dict[int, int] | None = None,
) -> Found:  # fmt: skip
    """Play a schedule with liars; `Violation` if a rule is broken that holds with liars too.

    The operator bars the hosts of `bars`, each at its moment. With `seats`, the fleet is secured.
    """
    given = {"classes": classes or {}, "bars": bars or {}, "seats": seats or {}}
    world = World(schedule, patience=5000.0, lies=lies, trusted=trusted, **given)  # type: ignore[arg-type]
    world.witness = LenientWitness(schedule.shape)
    _playing[:] = [world]
    honest = True
    with simulated_surroundings(lambda: _playing[0].disk):
        try:
            world.play()
        except Violation as found:
            if found.rule not in ("fitness", "content", "waste", "count"):
                raise
            honest = found.rule == "waste"
    disk, brought, forged = world.disk, Counter[str](), Counter[str]()
    for digest, worker, fitness in disk.read("SELECT digest, worker, fitness FROM recalled WHERE because = 'barred'"):
        host = worker.partition("/")[0]
        brought[host] += 1
        forged[host] += fitness != fitness_of_job(disk.jobs[digest])
    return Found(
        frozenset(map(world.name_of, lies)), frozenset(disk.barred), brought, forged, brought.total(),
        world.count_checks(), world.counted_jobs, world.scored.steps / 100, honest,
    )  # fmt: skip


def shape_of(workers: int, share: float, seed: int) -> Shape:
    """A run of eight generations, of 20 candidates in two episodes each, with two evaluations; half of them race."""
    search = {"generations": 8, "population": 20, "episodes": 2, "racing": seed % 2 == 1, "evaluate_every": 4}
    return Shape(workers, turn=0.5, run_seed=seed, verify=share, **search)


def campaign(plays: int, share: float, workers: tuple[int, ...]) -> Iterator[dict[str, Any]]:
    """A row for each size of the fleet, rate and kind of lie."""
    for count in workers:
        for rate in (0.01, 0.1, 0.5):
            for kind in ("by chance", "for a candidate"):
                found = [_one(count, share, rate, kind, seed) for seed in range(plays)]
                liars = [(each, host) for each in found for host in each.liars]
                caught = [each.brought[host] for each, host in liars if host in each.barred]
                forged = [each.forged[host] for each, host in liars if host in each.barred]
                whole = [each for each in found if each.liars <= each.barred]
                yield {
                    "workers": count, "lies": rate, "kind": kind, "plays": plays, "liars": len(liars),
                    "barred": len(caught), "wrongly": sum(len(each.barred - each.liars) for each in found),
                    "median brought": median(caught) if caught else None,
                    "median forged": median(forged) if forged else None,
                    "honest bits": f"{sum(each.is_honest for each in whole)} of {len(whole)}",
                }  # fmt: skip


def mixed(checks: int, share: float) -> dict[str, Any]:
    """Fleets of two classes, whose bits differ, under every kind of fault, until so many results were checked."""
    done, barred, plays = 0, 0, 0
    while done < checks:
        drawn = draw(7, plays)
        shape = replace(shape_of(4 + plays % 3, share, plays % 4), evaluate_every=2)
        faults = tuple(each for each in drawn.faults if each.kind not in ("stranger", "leave", "pause", "fail"))
        classes = {host: "ab"[host % 2] for host in range(shape.workers)}
        rounds: dict[int, Lie] = {host: _rounded for host, name in classes.items() if name == "b"}
        found = play_with(Schedule(shape, faults, drawn.name), rounds, classes=classes)
        done, barred, plays = done + found.checked, barred + len(found.barred), plays + 1
    return {"plays": plays, "checks": done, "accused": barred}


def _rounded(_job: Job, fitness: float) -> float:
    """As on a processor that rounds otherwise."""
    return fitness * (1 + 2**-52)


def _one(workers: int, share: float, rate: float, kind: str, seed: int) -> Found:
    shape = shape_of(workers, share, seed % 4)
    source = random.Random(f"{workers} {rate} {kind} {seed}")
    liars = source.sample(range(1, workers), 1 if workers < 8 else workers // 5)
    makes = {"by chance": lambda host: by_chance(rate, host + 31 * seed),
             "for a candidate": lambda host: for_a_candidate(rate, shape.population, host)}  # fmt: skip
    lies: dict[int, Lie] = {host: makes[kind](host) for host in liars}
    kills = tuple(Fault(source.uniform(0.5, 8.0), "kill_coordinator", 0, 0.5, source.uniform(0, 30)) for _ in range(2))
    return play_with(Schedule(shape, kills, f"liars {seed}"), lies, frozenset({0}))


def main() -> int:
    """Print a table; exit code 1 if an honest host was barred or a run lacks the honest bits."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulation.liars")
    parser.add_argument("--plays", type=int, default=10)
    parser.add_argument("--share", type=float, default=0.1)
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 3, 5, 10, 20])
    parser.add_argument("--mixed", type=int, default=0, help="check so many results of honest, mixed fleets instead")
    arguments = parser.parse_args()
    if arguments.mixed:
        row = mixed(arguments.mixed, arguments.share)
        print(json.dumps(row))
        return 1 if row["accused"] else 0
    totals: dict[str, int] = defaultdict(int)
    for row in campaign(arguments.plays, arguments.share, tuple(arguments.workers)):
        print(json.dumps(row), flush=True)
        honest, whole = row["honest bits"].split(" of ")
        totals["wrongly"] += row["wrongly"]
        totals["others"] += int(whole) - int(honest)
    return 1 if totals["wrongly"] or totals["others"] else 0


if __name__ == "__main__":
    sys.exit(main())
