"""`dreamfleet bar`: keep a host out of a run that the operator knows to score wrongly, or let it in again."""

import argparse
from time import monotonic, sleep

from dreamfleet.common.cli.global_config import add_global_flags, resolve_network
from dreamfleet.common.cli.output import add_json_flag, print_answer

SUMMARY = "bar a host that scores wrongly from a run, and score again all that it brought; --no-longer lets it in again"
EXTRAS = ()
TIMEOUT, PAUSE = 5.0, 0.2  # seconds


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("host", metavar="HOST", help="its worker's name, as `dreamfleet status` shows it")
    parser.add_argument(
        "run_name", nargs="?", metavar="RUN",
        help="name of the run (default: the only live one); a run without a coordinator is changed on this disk",
    )  # fmt: skip
    parser.add_argument(
        "--no-longer", action="store_true", help="let it join again, such as after its memory was replaced"
    )
    add_global_flags(parser, "connect", "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Ask the coordinator of a live run; without one, change the run's journal on this disk.

    Between two incarnations a coordinator holds the run's lock and does not answer, so it is asked again for a while.
    """
    from dreamfleet.common.client.client import Client
    from dreamfleet.common.errors import ConnectionFailedError
    from dreamfleet.common.files.regular_files import is_file
    from dreamfleet.common.protocol.keys import check_run_name, check_worker_name
    from dreamfleet.common.runs.run_folder import RunFolder
    from dreamfleet.common.runs.run_lock import is_run_locked
    from dreamfleet.common.runs.run_paths import JOURNAL, resume_command
    from dreamfleet.coordinator.run.recall import bar_stored

    host, name, then, until = check_worker_name(args.host), args.run_name, {}, monotonic() + TIMEOUT
    while True:
        try:
            with Client(resolve_network(args, "operator", "coordinator")) as client:
                name = name or client.status().run
                client.control(name, "unbar" if args.no_longer else "bar", host)
        except ConnectionFailedError:
            if name is None or not is_file((folder := args.runs_dir / check_run_name(name)) / JOURNAL):
                raise
            if is_run_locked(folder) and monotonic() < until:
                sleep(PAUSE)
                continue
            bar_stored(folder, host, is_barred=not args.no_longer)
            with RunFolder(folder) as stored:
                then = {} if stored.ended else {"continue": resume_command(folder)}
        break
    done = "may join again" if args.no_longer else "is barred, and what it brought is scored again"
    text = "".join(f"; continue the run with: {each}" for each in then.values())
    print_answer(args, f"run {name}: host {host} {done}{text}", run=name, host=host, barred=not args.no_longer, **then)
    return 0
