"""python -m tests.simulation --schedules 100000 --seed 1 --jobs 2: exit code 1 if a rule was broken.

A violation is printed with the smallest schedule that shows it; `--replay` takes that line and plays it again.
"""

from __future__ import annotations

import argparse
import sys

from tests.simulation.campaign import run, shrunk
from tests.simulation.schedule import Schedule
from tests.simulation.world import play


def main() -> int:
    """Exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulation", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--schedules", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first schedule")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--replay", metavar="SCHEDULE", help="play one schedule, as a violation prints it")
    arguments = parser.parse_args()
    if arguments.replay:
        outcome = play(Schedule.from_json(arguments.replay))
        print(f"{outcome.violation or 'no rule is broken'}\n{outcome.trace}{outcome.now:.2f} virtual seconds, "
              f"{outcome.events} events, faults: {dict(outcome.happened)}")  # fmt: skip
        return 1 if outcome.violation else 0
    tally = run(arguments.schedules, arguments.seed, arguments.jobs, arguments.first)
    for each in shrunk(tally, arguments.seed):
        print(f"\n{each.violation}\n{each.trace}replay with:\n  --replay '{each.schedule.to_json()}'")
    print(f"\n{tally}")
    return 1 if tally.failed else 0


if __name__ == "__main__":
    sys.exit(main())
