"""`dreamfleet pause|resume|drain|stop`: steer a run over Zenoh."""

import argparse
from dataclasses import dataclass

from dreamfleet.common.cli.global_config import add_global_flags, resolve_network
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.printable import printable


@dataclass(frozen=True)
class ControlVerb:
    """A verb that sends one request to the coordinator."""

    name: str
    SUMMARY: str
    outcome: str
    request_with_workers: str = ""  # the request with --workers; empty if the verb has no such flag
    coordinator_leaves: bool = False  # whether the coordinator leaves the run
    EXTRAS: tuple[str, ...] = ()

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the verb's arguments."""
        parser.add_argument("run_name", nargs="?", metavar="RUN", help="name of the run (default: the only live one)")
        if self.request_with_workers:
            parser.add_argument(
                "--workers", action="store_true", help="end its workers too, except those that serve any run (--any)"
            )
        add_global_flags(parser, "connect")
        add_json_flag(parser)

    def run(self, args: argparse.Namespace) -> int:
        """Send the request, and print how the run continues."""
        from dreamfleet.common.client.client import Client
        from dreamfleet.common.runs.lookup import naming_the_stored_run

        asked = self.request_with_workers if self.request_with_workers and args.workers else self.name
        network = resolve_network(args, "operator", "coordinator")
        with naming_the_stored_run(args.runs_dir, args.run_name), Client(network) as client:
            name = args.run_name or client.status().run
            command = printable(client.control(name, asked))
        again = command or f"dreamfleet coordinator --resume {name} --runs-dir FOLDER"
        more = {"continue": again} if self.coordinator_leaves else {}
        then = "".join(f"; continue it on its host with: {each}" for each in more.values())
        print_answer(args, f"run {name} {self.outcome}{then}", run=name, asked=asked, accepted=True, **more)
        return 0


PAUSE = ControlVerb(
    "pause", "give out no more jobs; what runs is finished and counts", "is paused; `dreamfleet resume` continues it"
)
RESUME = ControlVerb("resume", "go on after a pause; jobs that failed are tried again", "continues")
DRAIN = ControlVerb(
    "drain", "give out no more jobs, wait for those that run, then leave; the run can be continued", "is draining",
    coordinator_leaves=True,
)  # fmt: skip
STOP = ControlVerb(
    "stop", "leave now; the run can be continued", "is stopped", request_with_workers="disband", coordinator_leaves=True
)
