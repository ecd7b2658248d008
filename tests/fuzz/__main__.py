"""Call every verb with odd values, and print each call that ended in something else than a plain line.

    make fuzz CALLS=5000 SEED=7 VERB=runs

Every flag of every verb takes odd values, which the seed chooses; half of the calls have several. A call
that would run on is interrupted. Needs nothing of a network: each call has one of its own where the kernel allows it.
"""

import argparse
import os
import random
import shlex
import shutil
import sys
import tempfile
import time
from pathlib import Path

from tests.fuzz.calls import one_value_calls, parsers, random_call, write_stage
from tests.fuzz.forked import preload, start

POLL = 0.01  # seconds


def draw_calls(verbs, count, draw):
    """So many calls: half of them with one odd value, half with several."""
    single = [call for verb, parser in verbs.items() for call in one_value_calls(verb, parser)]
    draw.shuffle(single)
    single = single[: (count + 1) // 2]
    names = sorted(verbs)
    several = [random_call(name, verbs[name], draw) for name in draw.choices(names, k=count - len(single))]
    calls = single + several
    draw.shuffle(calls)
    return calls


def run_calls(calls, stage, jobs, limit):
    """Run the calls, so many at a time; yields each ended call with the complaint, '' for none."""
    waiting, running = list(reversed(calls)), {}
    while waiting or running:
        while waiting and len(running) < jobs:
            call = waiting.pop()
            folder = Path(tempfile.mkdtemp(dir=stage.parent))
            shutil.copytree(stage, folder / "work")
            os.mkfifo(folder / "work" / "pipe")
            for name in ("home", "tmp"):
                (folder / name).mkdir()
            child = start(call.argv, folder, limit)
            running[child.pid] = call, child
        for pid, (call, child) in list(running.items()):
            if (complaint := child.poll()) is None:
                continue
            del running[pid]
            shutil.rmtree(child.folder, ignore_errors=True)
            yield call, complaint
        time.sleep(POLL)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--verb", help="only verbs whose name begins so, such as runs.plot")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--limit", type=float, default=2.0, help="seconds until a call is interrupted")
    args = parser.parse_args()
    verbs, found = parsers(args.verb), 0
    calls = draw_calls(verbs, args.calls, random.Random(args.seed))
    preload()
    with tempfile.TemporaryDirectory(prefix="fuzz-", ignore_cleanup_errors=True) as folder:
        stage = write_stage(Path(folder) / "stage")
        for number, (call, complaint) in enumerate(run_calls(calls, stage, args.jobs, args.limit), 1):
            if number % 500 == 0:
                print(f"{number} of {len(calls)} calls", file=sys.stderr, flush=True)
            if not complaint:
                continue
            found += 1
            shown = " ".join(ascii(word) if not word.isascii() or not word.isprintable() else shlex.quote(word)
                             for word in call.argv)  # fmt: skip
            print(f"{shown if len(shown) < 600 else shown[:600] + '...'}\n  {complaint}\n", flush=True)
    print(f"{len(calls)} calls of {len(verbs)} verbs: {found} to mend")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
