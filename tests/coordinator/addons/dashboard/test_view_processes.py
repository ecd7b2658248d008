"""Live views without a browser: notices where there is no picture."""

import asyncio
import json

from dreamfleet.coordinator.addons.dashboard.view_processes import ViewProcesses, ViewTarget


def ending(views, target):
    """The last event of a view that shows nothing."""

    async def watch():
        said = [each async for each in views.events(target)]
        await views.close()
        return json.loads(said[-1].split(b"data: ")[1])

    return asyncio.run(watch())


def test_the_last_notice_is_its_processs_last_message(tmp_path):
    views = ViewProcesses(("--connect", "tcp/127.0.0.1:1"), tmp_path, 1)
    notice = ending(views, ViewTarget("night", "generation", "3"))
    assert (notice["state"], "'night'" in notice["text"]) == ("ended", True), notice


def test_where_no_views_are_allowed_none_begins(tmp_path):
    notice = ending(ViewProcesses(("--connect", "tcp/127.0.0.1:1"), tmp_path, 0), ViewTarget("night"))
    assert notice["state"] == "ended"


def test_a_target_becomes_flags_without_injection(tmp_path):
    place = ("--connect", "tcp/a:1", "tcp/b:2")
    for asked, flags in (
        ({"run": "night"}, ["--run=night", *place]),
        ({"run": "night", "best": ""}, ["--run=night", *place, "--best"]),
        ({"run": "night", "worker": "a/0a1b2c3d"}, ["--run=night", *place, "--worker=a/0a1b2c3d"]),
        ({"run": "night", "generation": "7"}, ["--controller=night", "--generation=7", f"--runs-dir={tmp_path}"]),
    ):
        assert ViewTarget.of(asked).flags(place, tmp_path) == flags
