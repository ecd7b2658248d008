"""The routes of the page, their access control, and live views without a browser. Tests assets.py, config.py, feed.py,
guard.py, view_processes.py and coordinator/addons/web/address.py, coordinator/addons/web/documents.py,
coordinator/addons/web/guard.py and coordinator/addons/web/server.py."""

import asyncio
import json
import re
import shutil
import threading
from functools import wraps
from itertools import product
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from dreamfleet.common.errors import UsageError
from dreamfleet.common.transport.network import Network
from dreamfleet.coordinator.addons.dashboard import stored_runs
from dreamfleet.coordinator.addons.dashboard.app import _Handlers, make_app
from dreamfleet.coordinator.addons.dashboard.assets import Assets
from dreamfleet.coordinator.addons.dashboard.config import DashboardConfig
from dreamfleet.coordinator.addons.dashboard.feed import Feed
from dreamfleet.coordinator.addons.dashboard.live_runs import DashboardSnapshot, Watcher
from dreamfleet.coordinator.addons.dashboard.view_processes import ViewProcesses, ViewTarget
from tests.support.journals import change_journal
from tests.support.processes import DEADLINE

HOME = "http://127.0.0.1:8420"
TOKEN = "correct horse battery"
REACHABLE = ("0.0.0.0", "::", "192.168.1.5", "example.org", "")
PATHS = (
    "/", "/runs", "/runs/dream", "/hosts/dream", "/compare/dream/reality", "/live", "/view?run=night", "/metrics",
    "/files/0/main.js",
)  # fmt: skip


def client_of(runs, host="127.0.0.1", base=HOME, **config):
    feed = Feed(Watcher(Network(connect=("tcp/127.0.0.1:1",)), None, runs))
    app = make_app(
        feed, ViewProcesses(("--connect", "tcp/127.0.0.1:1"), runs, 1), runs, DashboardConfig(host=host, **config)
    )
    return TestClient(app, base_url=base, follow_redirects=False)


@pytest.fixture
def client(runs):
    return client_of(runs)


@pytest.fixture
def guarded(runs):
    return client_of(runs, "0.0.0.0", "http://night.example:8420", token=TOKEN)


def test_the_pages_files_load_and_may_be_cached_for_ever_and_it_has_no_script_of_its_own_and_no_other_hosts(client):
    page = client.get("/")
    assert "http" not in page.text
    assert not re.search(r"<script(?![^>]*\bsrc=)|\son\w+=|style=", page.text)
    assert page.headers["cache-control"] == "no-store"
    found = re.findall(r'(?:src|href)="(files/[^"]+)"', page.text)
    assert {Path(each).name for each in found} == {"icon.svg", "style.css", "theme.js", "plotly.min.js", "main.js"}
    for each in found:
        for packing in ("gzip", "identity"):
            answer = client.get(f"/{each}", headers={"accept-encoding": packing})
            assert answer.status_code == 200
            assert "immutable" in answer.headers["cache-control"]
            assert answer.headers.get("content-encoding", "identity") == packing
    folder = next(each for each in found if each.endswith("main.js")).rpartition("/")[0]
    for name in ("charts.js", "compare.js", "dom.js", "hosts.js", "live.js", "runs.js", "view.js"):
        assert client.get(f"/{folder}/{name}").status_code == 200


def test_what_is_not_there_is_404(client):
    for path in ("files/0/main.js", "files/x/../../past.py", "no", "runs/no", "hosts/no", "compare/reality/no"):
        assert client.get(f"/{path}").status_code == 404, path


def test_past_runs_are_listed_with_what_is_wrong_with_them(runs):
    (runs / "broken").mkdir()
    (runs / "broken" / "journal.sqlite").write_text("no journal")
    assert client_of(runs / "nothing").get("/runs").json()["runs"] == []
    rows = {each["run"]: each for each in client_of(runs).get("/runs").json()["runs"]}
    assert set(rows) == {"broken", "dream", "hidden", "reality"}
    assert rows["broken"]["damaged"]
    assert (rows["dream"]["task"], rows["dream"]["generations"]) == ("dream", 12)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d UTC", rows["dream"]["begun"])
    assert rows["dream"]["best_error"] > 0


def test_only_an_open_run_is_listed_with_its_resume_command(runs, client):
    assert client.get("/runs/dream").json()["again"] == ""
    change_journal(runs / "dream", "DELETE FROM run WHERE key = 'ended'")
    rows = {each["run"]: each for each in client.get("/runs").json()["runs"]}
    assert f"coordinator --resume dream --runs-dir {runs}" in rows["dream"]["again"]
    assert client.get("/runs/dream").json()["again"] == rows["dream"]["again"]


def test_a_run_is_its_curves_facts_and_settings(client):
    document = client.get("/runs/dream").json()
    curves = document["curves"]
    assert curves["generation"] == list(range(12))
    assert all(low <= high for low, high in zip(curves["low"], curves["high"], strict=True))
    assert curves["steps"] == sorted(curves["steps"])
    assert curves["core_hours"] == sorted(curves["core_hours"])
    assert len(curves["evaluations"]["steps"]) == len(curves["evaluations"]["generation"]) > 0
    assert curves["dreamt"]
    assert ["task", "dream", True] in document["settings"]
    assert "spent" in dict(document["outcome"])
    assert document["tiles"][0]["name"] == "score"


def test_two_runs_are_compared_as_by_the_verb(runs, client):
    shutil.copytree(runs / "reality", runs / "again")
    found = client.get("/compare/reality/again").json()
    assert found["settings"] == []
    assert [each["size"].split()[-1] for each in found["differences"]] == ["0", "0"]
    (runs / "dream" / "bundle.zip").unlink()
    lacking = client.get("/compare/reality/dream").json()
    assert lacking["problem"], "its world is unknown"
    assert lacking["differences"] == []
    assert ["seed", "11", "12"] in lacking["settings"]


def test_hosts_are_those_of_the_journal(client):
    found = client.get("/hosts/reality").json()
    (host,) = found["hosts"]
    assert (host["host"], host["lives"], host["steps"]) == ("vm", 1, 5053)
    assert sum(host["rate"]) * found["width"] == pytest.approx(5053, rel=1e-3)


def test_a_run_that_closed_no_generation_is_shown(runs, client):
    for table in ("generation", "candidate", "evaluation", "result", "strategy"):
        change_journal(runs / "dream", f"DELETE FROM {table}")
    document = client.get("/runs/dream").json()
    assert (document["curves"]["generation"], document["generations"]) == ([], [])


def test_a_journal_whose_generations_are_far_apart_is_damaged_and_not_counted_through(runs, client):
    change_journal(runs / "dream", "UPDATE generation SET number = ? WHERE number = 3", 2**62)
    assert client.get("/runs/dream").status_code == 404


@pytest.mark.parametrize(
    "name", ["..", "%2e%2e", "..%2f..%2fetc", "%2Fetc%2Fpasswd", "a%00b", "Dream", "x" * 300, "archive%2Fx"]
)
def test_no_name_leads_out_of_the_runs_folder(runs, client, name):
    shutil.copytree(runs / "dream", runs.parent / "outside")
    for path in (f"/runs/{name}", f"/hosts/{name}", f"/compare/reality/{name}"):
        answer = client.get(path)
        assert answer.status_code in (404, 200)  # the client removes `..` from a path, and then requests the page
        assert not {"curves", "width", "differences"} & set(re.findall(r'"(\w+)":', answer.text))


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS"])
def test_only_get_is_allowed(client, method):
    assert {client.request(method, path).status_code for path in PATHS} == {405}


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8420", "127.0.0.1.evil.example", "localhost.evil.example", ""]
)
def test_a_foreign_host_name_that_resolves_here_is_refused_and_own_ones_are_answered(client, host):
    for path in PATHS:
        answer = client.get(path, headers={"host": host})
        assert (answer.status_code, "127.0.0.1" in answer.text) == (421, True), path
    for own in ("localhost:8420", "127.0.0.1", "[::1]:8420", "LOCALHOST"):
        assert client.get("/", headers={"host": own}).status_code == 200


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_another_sites_page_may_link_here_and_request_nothing_else(client, site):
    for path, mode in product(PATHS, ("cors", "no-cors", "navigate")):
        answer = client.get(path, headers={"sec-fetch-site": site, "sec-fetch-mode": mode})
        assert answer.status_code == (200 if (path, mode) == ("/", "navigate") else 403)


@pytest.mark.parametrize("path", ["/live", "/view?run=night"])
def test_head_of_an_endless_stream_gets_headers_only(client, path):
    answer = client.head(path)
    assert (answer.status_code, answer.headers["content-type"]) == (200, "text/event-stream; charset=utf-8")


@pytest.mark.parametrize(
    "asked", ["", "run=", "run=a/b", "run=a&worker=--out", "run=a&worker=a/../b", "run=a&worker=a/0a1b2c3d%0a",
              "run=a&generation=-1", "run=a&generation=1;2", "run=a&generation=%D9%A1x", "run=--help"],
)  # fmt: skip
def test_what_cannot_be_watched_is_refused_in_words(client, asked):
    answer = client.get(f"/view?{asked}")
    assert (answer.status_code, answer.text.count("\n")) == (400, 1)


def test_without_the_token_there_is_a_page_that_asks_for_it(guarded):
    wrong = ({}, {"authorization": "Bearer wrong"}, {"authorization": f"Basic {TOKEN}"},
             {"cookie": "dreamfleet=wrong"}, {"cookie": f"dreamfleet={TOKEN}"})  # fmt: skip
    for path in PATHS:
        assert {guarded.get(path, headers=headers).status_code for headers in wrong} == {401}, path
        answer = guarded.get(path, params={"token": "wrong<script>"})
        assert (answer.status_code, "<script>" in answer.text) == (401, False), path


def test_the_token_opens_by_bearer_and_by_an_address_that_leaves_a_cookie(guarded):
    assert guarded.get("/runs", headers={"authorization": f"Bearer {TOKEN}"}).status_code == 200
    answer = guarded.get("/", params={"token": TOKEN})
    assert (answer.status_code, answer.headers["location"]) == (303, "/")
    cookie = answer.headers["set-cookie"]
    assert TOKEN not in cookie
    assert "HttpOnly" in cookie
    assert "samesite=lax" in cookie.lower()
    assert guarded.get("/runs").status_code == 200


@pytest.mark.parametrize("path", ["/runs", "/%2F/evil.example", "/https:%2F%2Fevil.example"])
def test_no_redirect_leads_elsewhere(guarded, path):
    assert guarded.get(path, params={"token": TOKEN}).headers["location"] == "/"


@pytest.mark.parametrize("path", ["/", "/runs", "/runs/nothing", "/nothing"])
def test_every_answer_has_the_security_headers(client, path):
    headers = client.get(path).headers
    assert headers["x-content-type-options"] == "nosniff"
    policy = headers["content-security-policy"]
    assert all(each in policy for each in ("frame-ancestors 'none'", "script-src 'self';", "default-src 'none'"))
    assert headers["cross-origin-resource-policy"] == "same-origin"


def test_no_answer_holds_nan_or_infinity(runs, client):
    change_journal(runs / "dream", "UPDATE generation SET mean = 9e999, best = -9e999 WHERE number = 2")
    change_journal(runs / "dream", "UPDATE candidate SET fitness = 9e999 WHERE generation = 2")

    def refuse(word):
        raise AssertionError(word)

    for path in ("/runs", "/runs/dream", "/hosts/dream"):
        answer = client.get(path)
        assert answer.status_code == 200
        json.loads(answer.text, parse_constant=refuse)


def test_a_token_may_hold_non_ascii_letters(runs):
    for token, in_latin_1 in (("größer-als-日本語", 401), ("größer-als-zwölf", 200)):
        for encoding, code in (("utf-8", 200), ("latin-1", in_latin_1)):
            sent = {"authorization": f"Bearer {token}".encode(encoding, "replace")}
            assert client_of(runs, token=token).get("/runs", headers=sent).status_code == code


def test_concurrent_requests_share_one_read_of_the_list(runs, monkeypatch):
    read, held = [], threading.Event()

    def slowly(folder):
        read.append(folder)
        assert held.wait(DEADLINE)
        return []

    monkeypatch.setattr(stored_runs, "list_runs", slowly)
    feed = Feed(Watcher(Network(connect=("tcp/127.0.0.1:1",)), None, runs))
    answers = _Handlers(feed, ViewProcesses((), runs, 1), runs, Assets())

    async def ask():
        asked = [asyncio.create_task(answers.runs(None)) for _ in range(5)]
        await asyncio.sleep(0)  # each has begun
        held.set()
        return await asyncio.gather(*asked)

    assert [json.loads(each.body)["runs"] for each in asyncio.run(ask())] == [[]] * 5
    assert len(read) == 1


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.7", "localhost", "::1", *REACHABLE])
def test_only_a_loopback_address_needs_no_token(host):
    config = DashboardConfig(host=host, token=TOKEN if host in REACHABLE else None)
    assert config.is_loopback == (host not in REACHABLE)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        *(({"host": host}, "--token") for host in REACHABLE),
        ({"token": "short"}, r"--token.*\b12\b"), ({"port": -1}, "--port"), ({"port": 65536}, "--port"),
    ],
)  # fmt: skip
def test_what_is_no_address_or_token_or_lacks_one_is_refused(changes, named):
    with pytest.raises(UsageError, match=named):
        DashboardConfig(**changes)


def test_an_address_can_be_opened_and_its_repr_hides_the_token():
    assert TOKEN not in repr(DashboardConfig(token=TOKEN))
    assert DashboardConfig().url(8420) == "http://127.0.0.1:8420"
    assert DashboardConfig(host="::1").url(1) == "http://[::1]:1"


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


class Looks:
    """Counts looks; each waits until it is let."""

    def __init__(self):
        self.count, self.rests = 0, 0
        self.are_single = False  # whether each has to be let anew
        self.gate = threading.Event()
        self.gate.set()

    def poll(self):
        assert self.gate.wait(DEADLINE)
        self.count += 1
        if self.count == 2:
            raise ValueError("a look that fails")
        if self.are_single:
            self.gate.clear()
        return DashboardSnapshot({}, None, str(self.count).encode())

    def suspend(self):
        self.rests += 1


def played(test):
    """A test that is a coroutine, in a loop of its own."""

    @wraps(test)
    def play():
        asyncio.run(asyncio.wait_for(test(Looks()), 20))

    del play.__wrapped__  # or pytest looks for a fixture `looks`
    return play


@pytest.mark.slow
@played
async def test_all_viewers_share_the_snapshots(looks):
    looks.are_single = True

    async def viewer(feed, snapshots, everybody):
        source, seen = feed.snapshots(), []
        for _ in range(snapshots):
            seen.append(await anext(source))
            if await everybody.wait() == 0:  # all have it: let the next look begin
                looks.gate.set()
        return seen

    feed, everybody = Feed(looks, refresh=0.01, linger=0.05), asyncio.Barrier(50)
    found = await asyncio.gather(*(viewer(feed, 3, everybody) for _ in range(50)))
    assert len({tuple(map(id, seen)) for seen in found}) == 1
    assert looks.count <= 6, "the second failed, and cost itself alone"


@played
async def test_a_slow_viewer_skips_snapshots_and_delays_nobody(looks):
    feed = Feed(looks, refresh=0.0, linger=0.05)
    slow, fast = feed.snapshots(), feed.snapshots()
    first = await anext(slow)
    for _ in range(20):
        last = await anext(fast)
    assert int((await anext(slow)).absent_event) >= int(last.absent_event) > int(first.absent_event) + 10


@played
async def test_polling_stops_without_viewers_and_a_later_viewer_gets_no_stale_snapshot(looks):
    feed = Feed(looks, refresh=0.01, linger=0.02)
    async for _ in feed.snapshots():
        break
    while looks.rests == 0:
        await asyncio.sleep(0)
    assert feed._polling is None
    before = looks.count
    looks.gate.clear()
    later = asyncio.ensure_future(anext(feed.snapshots()))
    while feed._polling is None:
        await asyncio.sleep(0)
    assert not later.done()
    looks.gate.set()
    assert int((await later).absent_event) > before


@played
async def test_closing_the_feed_ends_every_stream(looks):
    feed = Feed(looks, refresh=0.01, linger=10)
    viewer = feed.snapshots()
    await anext(viewer)
    feed.close()
    assert [picture async for picture in viewer] == []
