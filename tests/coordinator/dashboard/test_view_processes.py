"""Live views without a browser: what is said where nothing can be watched."""

import asyncio
import json

from dreamfleet.coordinator.dashboard.view_processes import ViewProcesses, ViewTarget


def ending(views, target):
    """What is said last to whoever watches what cannot be watched."""

    async def watch():
        said = [each async for each in views.events(target)]
        await views.close()
        return json.loads(said[-1].split(b"data: ")[1])

    return asyncio.run(watch())


def test_what_its_process_says_as_it_ends_is_told(tmp_path):
    views = ViewProcesses(("--connect", "tcp/127.0.0.1:1"), tmp_path, 1)
    told = ending(views, ViewTarget("night", "generation", "3"))
    assert (told["state"], "no run 'night'" in told["text"]) == ("ended", True), told


def test_where_no_views_are_allowed_none_begins(tmp_path):
    told = ending(ViewProcesses(("--connect", "tcp/127.0.0.1:1"), tmp_path, 0), ViewTarget("night"))
    assert "no more are allowed" in told["text"]


def test_what_is_watched_becomes_flags_that_nothing_can_be_added_to(tmp_path):
    place = ("--connect", "tcp/a:1", "tcp/b:2")
    for asked, flags in (
        ({"run": "night"}, ["--run=night", *place]),
        ({"run": "night", "best": ""}, ["--run=night", *place, "--best"]),
        ({"run": "night", "worker": "a/0a1b2c3d"}, ["--run=night", *place, "--worker=a/0a1b2c3d"]),
        ({"run": "night", "generation": "7"}, ["--controller=night", "--generation=7", f"--runs-dir={tmp_path}"]),
    ):
        assert ViewTarget.of(asked).flags(place, tmp_path) == flags
