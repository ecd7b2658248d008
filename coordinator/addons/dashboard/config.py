"""The dashboard's settings: address, token and limits. Pages: README.md."""

from dataclasses import dataclass, field

from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.addons.web.address import WebAddress

LEAST_TOKEN = 12  # characters: anyone who reaches the port can guess


@dataclass(frozen=True)
class DashboardConfig(WebAddress):
    """Address, token, and the number of live views."""

    host: str = option("127.0.0.1", "listen here; addresses that others can reach need a token")
    port: int = option(8420, "port; 0: any that is free")
    views: int = option(4, "live views at a time, each a process on this computer; 0: none")
    token: str | None = field(
        default=None, repr=False,
        metadata={"help": "token that viewers must give; $DREAMFLEET_DASHBOARD_TOKEN keeps it out of process lists"},
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.views < 0:
            raise UsageError(f"--views must be at least 0, not {self.views}")
        if self.token is not None and len(self.token) < LEAST_TOKEN:
            raise UsageError(f"--token must have at least {LEAST_TOKEN} characters: `openssl rand -hex 16` makes one")
        if self.token is None and not self.is_loopback:
            raise UsageError(f"--host {self.host} shows the page to others: give a --token, or omit --host")
