"""Re-run the evolution of a controller on this host: `dreamfleet verify run` and one worker a core.

Ctrl-C leaves the run open, and the same command goes on with it. Exits with 0 if the same controller is reported, to
the bit.
"""

import argparse
import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

from dreamfleet.common.host.processes import VerbProcess, command
from dreamfleet.common.runs.run_paths import default_runs_dir


def main() -> int:
    """Run both sides until the run ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("controller", help="a file, a run, or one that ships")
    parser.add_argument("--runs-dir", type=Path, default=default_runs_dir())
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)), help="processes of one slot each")
    parser.add_argument("--port", type=int, default=7447)
    parser.add_argument("--task", help="what workers must know beside what is registered here: module:attribute")
    args = parser.parse_args()
    run, endpoint = f"{Path(args.controller).stem}-again", f"tcp/127.0.0.1:{args.port}"
    where = ("--run", run, "--runs-dir", args.runs_dir)
    with ExitStack() as stack:
        for name in (f"core-{number}" for number in range(args.workers)):
            joined = ("--connect", endpoint, "--run", run, "--name", name, "--slots", 1)
            joined += ("--task", args.task) if args.task else ()
            stack.enter_context(VerbProcess("worker", *joined, log=args.runs_dir / run / f"{name}.log"))
        return subprocess.run(
            command("verify", "run", args.controller, *where, "--listen", endpoint), check=False
        ).returncode


if __name__ == "__main__":
    sys.exit(main())
