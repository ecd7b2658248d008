"""Where a run is reached, and how it treats its workers. Pages: protocol.md, unattended.md, share-a-fleet.md."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from dreamfleet.common.cli.bounds import check_bounds
from dreamfleet.common.cli.config import option
from dreamfleet.common.protocol.messages import FleetShare, Share
from dreamfleet.common.transport.network import DEFAULT_ENDPOINT, parse_metrics_address
from dreamfleet.coordinator.settings.live_log import parse_sinks


@dataclass(frozen=True)
class NetworkConfig:
    """Where the coordinator is reached, and how it treats its workers."""

    listen: tuple[str, ...] = option((), f"listen here (default {DEFAULT_ENDPOINT}, unless --connect is given)")
    connect: tuple[str, ...] = option((), "connect to these stand-alone routers; with --listen, do both")
    beat: Annotated[float, Meta(ge=0.05, le=60.0)] = option(1.0, "seconds between a worker's beats")
    evaluation_share: Annotated[float, Meta(ge=0.0, le=0.9)] = option(
        0.25, "share of a busy fleet's time for evaluations, 0 to 0.9; 0: only idle slots"
    )  # the search needs the rest
    failure_limit: Annotated[float, Meta(ge=0.0, le=1.0)] = option(
        0.5, "pause when more than this share of the last five generations' candidates failed, 0 to 1"
    )
    share: FleetShare = option(
        1.0, "weight of this run among those that share workers: 3 gets three times the time of 1, while both have work"
    )
    strict: bool = option(
        False,
        "take results only of hosts that compute the same bits as the first one that scored, so that the run ends with "
        "the same bits even if processes are killed",
    )
    verify: Share = option(
        0.0,
        "share of each worker's results, 0 to 1, that another host of its class scores again; a host that differs is "
        "barred, and all its results are scored again (docs/how-to/trust.md)",
    )
    metrics_port: str = option(
        "",
        "serve Prometheus metrics under /metrics at this port of 127.0.0.1, or at HOST:PORT; anybody there may read "
        "them",
    )
    log_to: tuple[str, ...] = option(
        (),
        "also write the run's curves, as it goes on, to tensorboard, or to sinks of your own as MODULE:CLASS; a "
        "folder, project or address may stand behind a colon (docs/how-to/monitor.md). It has no flag",
        flag=False,
    )
    insecure: bool = option(
        False,
        "listen beyond this host without a join file: anyone who reaches the port owns the run, may read, forge "
        "and stop everything",
    )

    def __post_init__(self) -> None:
        if self.metrics_port:
            parse_metrics_address(self.metrics_port)
        parse_sinks(self.log_to)
        check_bounds(self)
