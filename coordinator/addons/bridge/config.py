"""The bridge's settings: address and tokens."""

import stat
from dataclasses import dataclass
from pathlib import Path

from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.addons.web.address import WebAddress

LEAST_TOKEN = 16  # characters: anyone who reaches the port can guess
MOST_TOKENS = 1000


@dataclass(frozen=True)
class BridgeConfig(WebAddress):
    """Where the bridge listens, and the file of its tokens."""

    host: str = option("127.0.0.1", "listen here; addresses that others can reach need --token-file")
    port: int = option(8700, "port; 0: any that is free")
    token_file: str | None = option(None, "file with a token in each line; every request must bear one of them")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.token_file is None and not self.is_loopback:
            raise UsageError(f"--host {self.host} lets others submit batches: give a --token-file, or leave --host out")

    def read_tokens(self) -> tuple[str, ...]:
        """The tokens, none without a file; `UsageError` if others may read the file, or a token is short."""
        if self.token_file is None:
            return ()
        path = Path(self.token_file)
        make = f"(umask 077; openssl rand -hex 32 > {path})"
        try:
            if path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
                raise UsageError(f"other users may read {path}: chmod 600 {path}")
            lines = path.read_text().splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise UsageError(f"--token-file {path} cannot be read ({error}); make one: {make}") from error
        tokens = tuple(filter(None, (line.strip() for line in lines if not line.startswith("#"))))
        if not tokens or len(tokens) > MOST_TOKENS:
            raise UsageError(f"{path} must hold 1 to {MOST_TOKENS} tokens, one a line; make one: {make}")
        if any(len(each) < LEAST_TOKEN or not each.isascii() for each in tokens):
            raise UsageError(f"each token in {path} must have at least {LEAST_TOKEN} ASCII characters: {make}")
        return tokens
