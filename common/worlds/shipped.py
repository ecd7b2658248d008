"""The worlds that ship. A gymnasium environment, or a world of another package, needs no profile."""

from __future__ import annotations

from dreamfleet.common.worlds import car_racing, takecover
from dreamfleet.common.worlds.profile import WorldProfile

WORLDS: dict[str, WorldProfile] = {each.task: each for each in (car_racing.PROFILE, takecover.PROFILE)}
