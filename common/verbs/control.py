"""`dreamfleet pause|resume|drain|stop`: steer a run over Zenoh."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.site import offer


@dataclass(frozen=True)
class ControlVerb:
    """A verb that asks the coordinator for one thing."""

    name: str
    SUMMARY: str
    outcome: str
    EXTRAS: tuple[str, ...] = ()

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the verb's arguments."""
        parser.add_argument("run_name", nargs="?", metavar="RUN", help="name of the run (default: the only live one)")
        offer(parser, "connect")
        add_json(parser)

    def run(self, args: argparse.Namespace) -> int:
        """Ask, and say what follows."""
        from dreamfleet.common.client import Client

        with Client(args.connect) as client:
            name = args.run_name or client.status().run
            client.control(name, self.name)
        answer(args, f"run {name} {self.outcome.format(run=name)}", run=name, asked=self.name, accepted=True)
        return 0


PAUSE = ControlVerb("pause", "give out no more jobs; what runs is finished and counts", "is paused; go on with resume")
RESUME = ControlVerb("resume", "go on after a pause; jobs that failed are tried again", "goes on")
DRAIN = ControlVerb(
    "drain", "give out no more jobs, wait for those that run, then leave; the run can be continued", "is draining"
)
STOP = ControlVerb(
    "stop",
    "leave now; the run can be continued",
    "is left by its coordinator; continue it on that host with: dreamfleet coordinator --resume {run}",
)
