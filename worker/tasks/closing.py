"""Closing an environment: its episodes are over, so a fault of its `close` is no longer theirs."""

from __future__ import annotations

import logging
from typing import Any

import gymnasium

from dreamfleet.common.host.foreign_code import contained
from dreamfleet.common.printable import one_line

log = logging.getLogger(__name__)
MAX_TEXT = 300  # characters of a fault


def close_environment(environment: gymnasium.Env[Any, Any]) -> None:
    """Close an environment; what its `close` raises is logged as a warning."""
    name = type(environment.unwrapped).__name__
    try:
        with contained(f"closing the environment {name}"):
            environment.close()
    except (Exception, SystemExit) as error:  # environments may raise anything
        log.warning("closing the environment %s failed, after it was used: %s: %s", name, type(error).__name__,
                    one_line(str(error))[:MAX_TEXT])  # fmt: skip
