"""python -m tests.simulation --schedules 100000 --seed 1 --jobs 2: exit code 1 if a rule was broken.

A violation is printed with the smallest schedule that shows it; `--replay` takes that line and plays it again.
"""

from __future__ import annotations

import argparse
import json
import sys

from tests.simulation.campaign import run, shrunk
from tests.simulation.schedule import Schedule
from tests.simulation.world import Outcome, play


def main() -> int:
    """Exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.simulation", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--schedules", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first schedule")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    parser.add_argument("--replay", metavar="SCHEDULE", help="play one schedule, as a violation prints it")
    arguments = parser.parse_args()
    if arguments.replay:
        return _replay(arguments.replay)
    tally, report = run(arguments.schedules, arguments.seed, arguments.jobs, arguments.first)
    found = [_describe(outcome) for outcome in shrunk(tally, arguments.seed)]
    if arguments.json:
        print(json.dumps(report | {"found": found}))
        return 1 if found else 0
    for each in found:
        print(f"\n{each['violation']}\n{each['trace']}replay with:\n  --replay '{each['schedule']}'")
    print(
        f"\n{report['schedules']} schedules, {report['faults']} faults, {report['events']} events, "
        f"{report['virtual_hours']} virtual hours in {report['seconds']} s: {report['violations']} violations"
    )
    return 1 if found else 0


def _replay(text: str) -> int:
    outcome = play(Schedule.from_json(text))
    described = _describe(outcome)
    print(f"{described['violation'] or 'no rule is broken'}\n{described['trace']}{outcome.now:.2f} virtual seconds, "
          f"{outcome.events} events, faults: {dict(outcome.happened)}")  # fmt: skip
    return 1 if outcome.violation else 0


def _describe(outcome: Outcome) -> dict[str, str]:
    violation = "" if outcome.violation is None else str(outcome.violation)
    return {"violation": violation, "schedule": outcome.schedule.to_json(), "trace": outcome.trace}


if __name__ == "__main__":
    sys.exit(main())
