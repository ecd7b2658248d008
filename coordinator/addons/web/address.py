"""Where a web server of an add-on listens."""

from dataclasses import dataclass

from dreamfleet.common.errors import UsageError
from dreamfleet.common.transport.network import is_loopback_host


@dataclass(frozen=True)
class WebAddress:
    """A host name or address of this computer, and a port; 0: any that is free."""

    host: str
    port: int

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise UsageError(f"--port must be from 0 to 65535, not {self.port}")

    @property
    def is_loopback(self) -> bool:
        """Whether only this computer can reach it."""
        return is_loopback_host(self.host)

    def url(self, port: int) -> str:
        """The URL, which ends without `/`."""
        return f"http://{f'[{self.host}]' if ':' in self.host else self.host}:{port}"
