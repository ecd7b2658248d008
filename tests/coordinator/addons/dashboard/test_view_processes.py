"""Live views without a browser: notices where there is no picture."""

import asyncio
import json
from pathlib import Path

import pytest

from dreamfleet.coordinator.addons.dashboard.view_processes import ViewProcesses, ViewTarget

PLACE = ("--connect", "tcp/127.0.0.1:1")


@pytest.mark.parametrize(("allowed", "target"), [(1, ViewTarget("night", "generation", "3")), (0, ViewTarget("night"))])
def test_a_view_that_shows_nothing_ends_with_a_notice(tmp_path, allowed, target):
    views = ViewProcesses(PLACE, tmp_path, allowed)

    async def watch():
        said = [each async for each in views.events(target)]
        await views.close()
        return json.loads(said[-1].split(b"data: ")[1])

    notice = asyncio.run(watch())
    assert notice["state"] == "ended"
    assert ("'night'" in notice["text"]) == bool(allowed), "the last message of its process"


@pytest.mark.parametrize(
    ("asked", "flags"),
    [
        ({"run": "night"}, ["--run=night", *PLACE]),
        ({"run": "night", "best": ""}, ["--run=night", *PLACE, "--best"]),
        ({"run": "night", "worker": "a/0a1b2c3d"}, ["--run=night", *PLACE, "--worker=a/0a1b2c3d"]),
        ({"run": "night", "generation": "7"}, ["--controller=night", "--generation=7", "--runs-dir=runs"]),
    ],
)
def test_a_target_becomes_flags_without_injection(asked, flags):
    assert ViewTarget.of(asked).flags(PLACE, Path("runs")) == flags
