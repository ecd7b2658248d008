"""A real fleet whose parts are killed, stopped, cut off and restarted, and one that nobody disturbs: the same bits?

    make chaos FAULTS=1000 SEED=7
    make weekend FAULTS=100

The second has candidates that fail, long outages and clock steps too, as a weekend that nobody watches. Faults come
from the seed, each after a number of accepted results more than the one before; the last quarter strikes a task whose
slots score 256 jobs together. Prints one line of JSON: for each task whether every fitness, vector and the mean are
equal, jobs lost, and the share of environment steps that did not count.
"""

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from dreamfleet.common.runs.run_folder import open_run
from tests.chaos.fleet import EPISODES, POPULATION, Fleet, accepted
from tests.chaos.kinds import KINDS
from tests.support import same_bits, tasks
from tests.support.bundles import write_random_bundle
from tests.support.disks import small_disk
from tests.support.hosts import new_host
from tests.support.processes import processes_in
from tests.support.wall_clock import WallClock

CALM = 300.0  # seconds without a new result that mean a hung run
RUNS_DISK, CACHE_DISK = 600, 80  # megabytes


@dataclass(frozen=True)
class Stage:
    """A task, and how many results come between two faults."""

    name: str
    task: str
    jobs_a_fault: int
    settings: tuple = ()

    def generations(self, faults):
        """That so many faults need."""
        return faults * self.jobs_a_fault // (POPULATION * EPISODES) + 4


NARROW = Stage("narrow", tasks.COUNTED, 50)
FAILING = Stage("failing", "gym:tests.support.weekend_world:Weekend-v0", 100, ("--on-failure", "worst"))
WIDE = Stage("wide", f"{tasks.MODULE}:Wide", 500)  # a slot that is killed loses twenty jobs


def drive(processes, bundle, stage, generations, faults, seed, kinds):
    """Run to the end under `faults` faults; what happened, and which kinds this machine cannot do."""
    with ExitStack() as stack:
        host = stack.enter_context(new_host())
        runs = stack.enter_context(small_disk(processes.runs, RUNS_DISK))
        cache = stack.enter_context(small_disk(processes.cache, CACHE_DISK))
        clock = WallClock(processes.folder / "clock") if stage is FAILING and WallClock.possible() else None
        model = "none" if stage is FAILING else bundle
        fleet = Fleet(processes, model, generations, seed, stage.task, *stage.settings, host=host, runs=runs,
                      cache=cache, clock=clock)  # fmt: skip
        stack.callback(processes.end)  # before the disks go
        happened = Counter(dict.fromkeys(kinds, 0))
        _drive(fleet, processes, stage, faults, happened)
        return happened, [name for name in kinds if not KINDS[name].possible(fleet)], *outcome(processes, generations)


def _drive(fleet, processes, stage, faults, happened):
    done = next_fault = 0
    moved = time.monotonic()
    possible = {name: KINDS[name].often for name in happened if KINDS[name].possible(fleet)}
    try:
        while not fleet.over():
            time.sleep(0.05)
            fleet.heal()
            now_done = accepted(processes)
            if now_done > done:
                done, moved = now_done, time.monotonic()
            if time.monotonic() - moved > CALM:
                raise AssertionError(f"no result for {CALM:g} s at {done} results; faults so far: {happened}")
            if happened.total() < faults and done >= next_fault:
                next_fault = done + stage.jobs_a_fault
                name = fleet.random.choices(*zip(*possible.items(), strict=True))[0]
                KINDS[name](fleet, fleet.random.randrange(len(fleet.workers)))
                happened[name] += 1
                if happened.total() % 20 == 0:
                    print(f"{stage.name}: {happened.total()} faults, {done} results", file=sys.stderr, flush=True)
    finally:
        fleet.end()


def outcome(processes, generations):
    """What the run computed, jobs lost, and jobs that count."""
    shutil.copytree(processes.runs, processes.folder / "runs-as-they-ended")  # their disk goes
    whole = same_bits.outcome(processes, "run")
    with open_run(processes.runs, "run") as run:
        scored = zip(whole.episodes, whole.fitness, strict=True)
        lost = sum(EPISODES - len(episodes) for episodes, fitness in scored if fitness is not None)
        lost += generations * POPULATION - len(whole.fitness)
        return whole._asdict(), lost, run.result_count()


def compare(folder, faults, seed, stage=NARROW, kinds=tuple(KINDS)):
    """Both fleets; the figures."""
    generations = stage.generations(faults)
    outcomes = []
    for name, count in (("calm", 0), ("chaos", faults)):
        place = folder / f"{stage.name}-{name}"
        steps = place / "steps"
        steps.mkdir(parents=True)
        os.environ[tasks.STEPS_FOLDER], os.environ[tasks.ODD_REWARD] = str(steps), str(place / "reward")
        bundle = write_random_bundle(place / "random.zip").path
        write_random_bundle(place / "other.zip", seed=9)
        started = time.monotonic()
        with processes_in(place) as processes:
            happened, skipped, whole, lost, jobs = drive(processes, bundle, stage, generations, count, seed, kinds)
        outcomes.append(whole)
        made, counted = tasks.steps_made(steps), 10 * jobs
        seconds = time.monotonic() - started
        print(f"{stage.name}, {name}: {seconds:.0f} s, {made} steps made, {counted} counted", file=sys.stderr)
    calm, chaos = outcomes
    different = [name for name in calm if calm[name] != chaos[name]]
    for name in different:
        print(f"{stage.name}: {name} differ: {_first_difference(calm[name], chaos[name])}", file=sys.stderr)
    return {
        "identical": not different, "lost": lost, "waste": made and round(1 - counted / made, 4),
        "faults": dict(happened), "skipped": skipped, "jobs": jobs, "made": made, "seconds": round(seconds),
    }  # fmt: skip


def _first_difference(calm, chaos):
    """The first place where they differ, for people."""
    if not isinstance(calm, list) or len(calm) != len(chaos):
        return f"{calm!r:.300} and {chaos!r:.300}"
    place = next(place for place, pair in enumerate(zip(calm, chaos, strict=True)) if pair[0] != pair[1])
    return f"at {place}: {calm[place]!r:.300} and {chaos[place]!r:.300}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--faults", type=int, default=200)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--kinds", default=",".join(KINDS), help=f"of faults, with commas between: {', '.join(KINDS)}")
    parser.add_argument("--without", default="", help="kinds that are left out")
    stages = ("narrow", "wide", "both", "failing")
    parser.add_argument("--stage", choices=stages, default="both", help="width 1, 256, both; episodes that fail")
    parser.add_argument("--folder", type=Path, help="a new folder, which is kept")
    arguments = parser.parse_args()
    kinds = tuple(name for name in arguments.kinds.split(",") if name not in arguments.without.split(","))
    if unknown := set(kinds) - KINDS.keys():
        parser.error(f"no such kind of fault: {', '.join(unknown)}; there are: {', '.join(KINDS)}")
    with ExitStack() as stack:
        folder = arguments.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=arguments.folder is None)
        both = {NARROW: arguments.faults - arguments.faults // 4, WIDE: arguments.faults // 4}
        alone = {stage.name: {stage: arguments.faults} for stage in (NARROW, WIDE, FAILING)}
        figures = {
            stage.name: compare(folder, count, arguments.seed, stage, kinds)
            for stage, count in alone.get(arguments.stage, both).items() if count
        }  # fmt: skip
    print(json.dumps(figures))
    return 0 if all(each["identical"] and not each["lost"] for each in figures.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
