"""`dreamfleet replay`: a stored fitness again, to the bit."""

from __future__ import annotations

import argparse
import json
import re
import sys

from dreamfleet.common.errors import JournalError, UsageError
from dreamfleet.common.site import offer

SUMMARY = "score a candidate of a run again and compare with the journal, to the bit"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    parser.add_argument("--candidate", required=True, metavar="G/I", help="generation and index, such as 3/0")
    offer(parser, "runs_dir")
    parser.add_argument("--json", action="store_true", help="print the episodes as JSON")


def run(args: argparse.Namespace) -> int:
    """Replay each episode; exit 1 if one differs."""
    import numpy as np

    from dreamfleet.common.fingerprint import fingerprint
    from dreamfleet.common.runs import open_run
    from dreamfleet.worker.tools.replay import replay

    found = re.fullmatch(r"(\d{1,12})/(\d{1,12})", args.candidate)
    if not found:
        raise UsageError(f"--candidate {args.candidate!r}: write generation/index, such as 3/0")
    with open_run(args.runs_dir, args.run_name) as stored:
        episodes = list(replay(stored, int(found[1]), int(found[2])))
        told, written_by = stored.fitness(int(found[1]), int(found[2])), stored.fingerprint
    if not episodes:
        raise JournalError(f"candidate {args.candidate} of run {args.run_name} has no results yet")
    same = all(each.stored == each.replayed for each in episodes)
    mean = float(np.mean([each.replayed for each in episodes]))
    if args.json:
        rows = [vars(each) for each in episodes]
        print(json.dumps({"identical": same, "fitness": mean, "stored_fitness": told, "episodes": rows}))
    else:
        for each in episodes:
            mark = "same bits" if each.stored == each.replayed else "DIFFERS"
            print(
                f"episode {each.episode}  seed {each.seed}  stored {each.stored!r}  replayed {each.replayed!r}  {mark}"
            )
    if not same and written_by != fingerprint():
        print(f"this host differs from the one that scored: [{fingerprint()}] against [{written_by}]", file=sys.stderr)
    return 0 if same else 1
