"""The worlds that packages register at `dreamfleet.worlds`. A gymnasium environment needs no profile."""

from dreamfleet.common.host.add_ons import load_registered
from dreamfleet.common.worlds.profile import WorldProfile

WORLDS: dict[str, WorldProfile] = load_registered("dreamfleet.worlds")  # docs/reference/worlds.md
