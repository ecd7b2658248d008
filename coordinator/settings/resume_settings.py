"""How a run was last served, kept with it: a run that is continued has the same limits and the same network.

Both are facts of the journal, as JSON of what differs from the defaults. What a flag, the file or the environment says
when a run is continued is stronger, and is kept from then on. Pages: stop-and-resume.md, configure.md, router.md.
"""

import json
from dataclasses import fields, replace
from typing import Any

from dreamfleet.common.cli.config import Table, read_table
from dreamfleet.common.cli.global_config import GlobalConfig
from dreamfleet.common.errors import JournalError, UsageError
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.security.credentials import Credentials
from dreamfleet.common.transport.network import DEFAULT_ENDPOINT, SECURED_ENDPOINT
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig

LIMITS, NETWORK = "limits", "network"  # the facts' names


def serving_facts(limits: LimitsConfig, network: NetworkConfig) -> dict[str, str]:
    """The facts to keep, by name."""
    kept = {LIMITS: _non_defaults(limits), NETWORK: _non_defaults(network)}
    return {name: json.dumps(each, allow_nan=False) for name, each in kept.items()}


def stored_limits(stored: RunFolder) -> Table:
    """The limits that a run was last served with; empty if it kept none."""
    return _read(stored, LIMITS, LimitsConfig)


def stored_network(stored: RunFolder) -> Table:
    """Where a run was last reached, and how it treated its workers."""
    return _read(stored, NETWORK, NetworkConfig)


def choose_addresses(
    own: NetworkConfig, global_config: GlobalConfig, kept: Table, credentials: Credentials | None = None
) -> NetworkConfig:
    """Where a coordinator is reached: as configured, else as stored with the run, else on this host alone.

    `connect` of the site says where everybody finds the router. A coordinator that listens is that router, and
    connects to another one only if its own flag or table says so. With a join file it is reached where that says.
    """
    listen, connect = own.listen or global_config.listen, own.connect
    if not listen and not connect:  # where everybody else connects to does not say where this one was
        listen, connect = kept.get("listen", ()), kept.get("connect", ())
    if not listen and not connect:
        connect = global_config.connect or (credentials.connect if credentials else ())
    default = DEFAULT_ENDPOINT if credentials is None else SECURED_ENDPOINT
    return replace(own, listen=listen or (() if connect else (default,)), connect=connect)


def _read(stored: RunFolder, name: str, section: type[Any]) -> Table:
    try:
        return read_table(section, f"the {name} kept with run {stored.name}", json.loads(stored.fact(name) or "{}"))
    except (ValueError, AttributeError) as error:
        raise JournalError(f"the {name} kept with run {stored.name} are damaged: {error}") from error
    except UsageError as error:
        raise JournalError(f"{error}: install a newer dreamfleet") from error


def _non_defaults(config: Any) -> dict[str, Any]:
    values = {each.name: (getattr(config, each.name), each.default) for each in fields(config)}
    return {name: value for name, (value, default) in values.items() if value != default}
