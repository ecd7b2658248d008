"""The page in a real browser, about real coordinators and workers. Tests coordinator/addons/dashboard/verb.py."""

import dataclasses
import json
import signal
import socket
import time
import urllib.error
import urllib.request
from contextlib import ExitStack

import pytest

from dreamfleet.common.printable import format_number
from tests.support import tasks
from tests.support.browser import dashboard, tab, wait_until
from tests.support.browser import wait_for_text as wait
from tests.support.processes import DEADLINE, free_port, refused
from tests.support.served import WORKER, serving, snapshot

TOKEN = "correct horse battery"
PAINTED = "all => all.every(each => each.getContext('2d').getImageData(each.width - 4, 9, 1, 1).data[3] > 0)"
LEFT_OUT = ("Failed to load resource", "net::ERR")  # what a browser says by itself of a server that is gone


@pytest.fixture
def page(browser, processes):
    with dashboard(processes) as started, tab(browser) as page:
        page.goto(started.address)
        yield page


def drawn(page, text):
    """Wait until the fitness chart says so of its last generation."""
    script = "text => document.querySelector('[data-part=fitness]')?.getAttribute('aria-label')?.includes(text)"
    wait_until(page, script, text)


def part(page, name):
    return page.locator(f"[data-part={name}]").first.text_content()  # also of rows out of sight


def without_absence(page):
    page.said[:] = [each for each in page.said if not each.startswith(LEFT_OUT)]


@pytest.mark.slow
def test_it_follows_a_run_from_nobody_through_losses_to_its_end(page, processes, small, record_property):
    wait(page, "no coordinator")
    assert processes.endpoint in part(page, "sentence")
    wait(page, "dreamfleet coordinator --run NAME", "task")
    left = processes.coordinator(*small, "--episodes", 2)
    wait(page, "waiting for workers")
    assert processes.call("pause", "test", "--connect", processes.endpoint)[0] == 0
    wait(page, "By hand", "sentence")
    left.popen.send_signal(signal.SIGTERM)
    wait(page, "left open")
    wait(page, "--resume test", "sentence")
    coordinator = processes.resume("test", "--generations", 1000)
    coordinator.wait_until_serving()
    assert processes.call("resume", "test", "--connect", processes.endpoint)[0] == 0
    wait(page, "waiting for workers")
    assert part(page, "run") == "test"
    worker = processes.worker("--task", tasks.SLOW_TOY, "--name", "alpha")
    wait(page, "running")
    drawn(page, "Generation ")  # a busy browser skips some
    assert page.locator("[data-part=fitness] .scatterlayer .trace").count() >= 3
    assert page.locator("[data-part=cells] .cell").count() == 4
    assert "of 1,000 generations" in part(page, "eta")
    assert "alpha" in part(page, "workers")
    assert not page.locator(".workers [data-label=picture]").first.is_visible()  # this task says nothing of pictures
    row = ".workers tr[data-state=present] td:has-text('alpha')"
    page.wait_for_selector(row, state="attached")
    began = time.monotonic()
    worker.popen.kill()
    page.wait_for_selector(row, state="detached")
    record_property("seconds until a killed worker went", time.monotonic() - began)
    wait(page, "waiting for workers")
    coordinator.popen.kill()
    wait(page, "coordinator lost since")
    assert "--resume test" in part(page, "sentence")
    resumed = processes.resume("test", "--generations", 4)
    processes.worker("--task", tasks.SLOW_TOY, "--name", "beta")
    wait(page, "ended")
    assert resumed.finish()[0] == 0
    assert "4 generations" in part(page, "sentence")
    drawn(page, "Generation 3:")
    without_absence(page)


SCORES = """async numbers => {
    const {score} = await import(document.querySelector("script[type=module]").src.replace("main.js", "dom.js"));
    return numbers.map(score);
}"""


@pytest.mark.slow
def test_tiny_and_huge_scores_are_short_as_elsewhere(page):
    numbers = [1.837e-24, -4.127e-05, 3e15, 0.0123, 0, 875.62]
    assert page.evaluate(SCORES, numbers) == ["1.837e-24", "-4.127e-05", "3e+15", "0.0123", "0.0", "875.6"]
    assert [format_number(each) for each in numbers[:3]] == page.evaluate(SCORES, numbers[:3])


@pytest.mark.slow
def test_the_dashboard_may_die_and_come_back(browser, processes, small):
    processes.coordinator(*small)
    port = free_port()
    with tab(browser) as page:
        with dashboard(processes, "--port", port) as first:
            page.goto(first.address)
            wait(page, "waiting for workers")
            first.popen.kill()
            page.wait_for_selector("#silent:not([hidden])")
            assert "No word from the dashboard" in page.inner_text("#silent")
        with dashboard(processes, "--port", port):
            page.wait_for_selector("#silent", state="hidden")
            wait(page, "waiting for workers")
            page.goto("about:blank")
        without_absence(page)


@pytest.mark.slow
def test_hostile_names_and_errors_stay_text(browser, processes):
    nasty = "<img src=x onerror=alert(1)><script>alert(2)</script>\x1b[31m\u202e"
    hostile = snapshot(workers=1, why=nasty, state="paused", refused={nasty: nasty}, dropped={nasty: 7})
    settings = hostile.status.settings
    task = dataclasses.replace(settings.task, task=nasty[:60])  # somebody's own program may say so
    status = dataclasses.replace(hostile.status, settings=dataclasses.replace(settings, task=task))
    worker = dataclasses.replace(WORKER, worker=f"{nasty}/0a1b2c3d"[:120], drawn_by="<b>native</b>")
    with serving(processes.endpoint, dataclasses.replace(hostile, status=status, workers=(worker,))), \
            dashboard(processes) as started, tab(browser) as page:  # fmt: skip
        page.on("dialog", lambda dialog: page.said.append(dialog.message))
        page.goto(started.address)
        wait(page, "paused")
        assert "<img src=x onerror=alert(1)>" in part(page, "sentence")
        assert "\\x1b[31m" in part(page, "sentence")
        assert "<script>" in part(page, "workers")
        assert page.locator("main img:not([data-part]), main script").count() == 0


@pytest.mark.slow
def test_several_live_runs_can_be_chosen_among(browser, processes):
    with serving(processes.endpoint, snapshot(), snapshot(name="lucid")), \
            dashboard(processes) as started, tab(browser) as page:  # fmt: skip
        page.goto(f"{started.address}#/live/night")
        wait(page, "night", "run")
        wait(page, "running")
        page.click("[data-part=chooser] a:text-is('lucid')")
        wait(page, "lucid", "run")
        page.goto(f"{started.address}#/live/elsewhere")
        wait(page, "elsewhere", "run")
        wait(page, "no coordinator")
        assert page.locator("[data-part=chooser] a").all_inner_texts() == ["lucid", "night"]


@pytest.mark.slow
def test_past_runs_are_searched_sorted_opened_and_compared_by_keyboard(browser, processes, runs):
    (runs / "broken").mkdir()
    (runs / "broken" / "journal.sqlite").write_text("no journal")
    with dashboard(processes) as started, tab(browser) as page:
        page.goto(f"{started.address}#/runs")
        rows = page.locator("[data-part=rows] tr")
        page.wait_for_selector("[data-part=rows] tr")
        assert rows.count() == 4
        page.focus("th button")
        page.keyboard.press("Enter")
        assert [each.split()[0] for each in rows.all_inner_texts()] == ["broken", "dream", "hidden", "reality"]
        page.keyboard.press("Enter")
        assert [each.split()[0] for each in rows.all_inner_texts()] == ["reality", "hidden", "dream", "broken"]
        page.fill("[data-part=search]", "dream")
        assert rows.count() == 1
        page.fill("[data-part=search]", "nothing at all")
        assert "No run has these words" in part(page, "none")
        page.fill("[data-part=search]", "")
        for name in ("dream", "reality"):
            page.focus(f"input[aria-label='compare {name}']")
            page.keyboard.press("Space")
        page.focus("[data-part=compare]")
        page.keyboard.press("Enter")
        page.wait_for_selector("[data-part=chart] .scatterlayer .trace")
        for over in ("steps", "core_hours"):
            page.check(f"input[name=over][value={over}]")
            assert page.locator("[data-part=chart] .scatterlayer .trace").count() == 2
        page.check("input[name=of][value=candidates]")
        assert "not scored alike" in part(page, "caption"), "dreamt fitness and driven one"
        page.goto(f"{started.address}#/run/dream")
        page.wait_for_selector("[data-part=fitness] .scatterlayer .trace")
        assert page.locator("[data-part=generations] tr").count() == 12
        page.goto(f"{started.address}#/live/dream")
        page.wait_for_url("**/#/run/dream")
        wait(page, "ended: 12 generations")
        page.fill("[data-part=settings-search]", "sigma0")
        assert [each.split() for each in page.locator("[data-part=settings] tr:visible").all_inner_texts()] == [
            ["sigma0", "0.1"]
        ]
        page.goto(f"{started.address}#/hosts/dream")
        page.wait_for_selector("[data-part=rate] .scatterlayer .trace")
        assert "vm" in part(page, "hosts")
        page.wait_for_selector("text=This journal names no arrivals")
        page.goto(f"{started.address}#/run/broken")
        page.wait_for_selector("text=This cannot be shown")
        page.goto(f"{started.address}#/run/..%2F..%2Fetc")
        page.wait_for_selector("text=the dashboard answered 404")
        without_absence(page)  # a browser logs each 404


@pytest.mark.slow
@pytest.mark.parametrize(("width", "scheme"), [(390, "light"), (1280, "dark")])
def test_it_fits_a_phone_and_follows_the_systems_colours(browser, processes, width, scheme):
    name = "a-rather-long-host-name-" * 2
    names = tuple(dataclasses.replace(WORKER, worker=f"{name}{n}/0a1b2c3d") for n in range(60))
    with serving(processes.endpoint, dataclasses.replace(snapshot(40, workers=60), workers=names)), \
            dashboard(processes) as started, \
            tab(browser, viewport={"width": width, "height": 844}, color_scheme=scheme) as page:  # fmt: skip
        page.goto(started.address)
        wait(page, "running")
        drawn(page, "Generation 39")
        assert page.evaluate("document.documentElement.scrollWidth") == width
        cut = "all => all.filter(each => each.scrollWidth > each.clientWidth + 1).length"
        assert page.eval_on_selector_all("td.name, h1, .tile b", cut) == 0, "no name is cut"
        page.wait_for_selector(".workers tbody tr:nth-child(60)", state="attached")
        assert page.eval_on_selector_all(".workers canvas", PAINTED), "also out of sight, for screenshots and print"
        page_colour = "getComputedStyle(document.documentElement).backgroundColor"
        dark = page.evaluate(page_colour) == "rgb(14, 19, 26)"
        assert dark == (scheme == "dark")
        for _ in range(2 if scheme == "light" else 1):  # system, light, dark
            page.click("#theme")
        assert (page.evaluate(page_colour) == "rgb(14, 19, 26)") != dark
        page.reload()
        wait(page, "running")
        assert (page.evaluate(page_colour) == "rgb(14, 19, 26)") != dark, "a choice is kept"


@pytest.mark.slow
def test_everything_can_be_reached_by_keyboard_and_the_focus_is_seen(page):
    page.wait_for_selector("#theme")
    reached = []
    for _ in range(6):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("document.activeElement.textContent.trim()"))
        assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none"
    assert reached == ["Skip to the run", "dreamfleet", "Live", "Runs", "Hosts", "Theme: system"]


def busy(page):
    """Milliseconds that the page's main thread has worked, as its own clock has it, and updates that it painted."""
    metrics = page.cdp.send("Performance.getMetrics")["metrics"]
    seconds = next(each["value"] for each in metrics if each["name"] == "TaskDuration")
    return 1000 * seconds, page.evaluate("performance.getEntriesByName('update').length")


@pytest.mark.long
def test_five_thousand_generations_and_five_hundred_workers_are_painted_in_no_time(browser, processes):
    with serving(processes.endpoint, snapshot(5000, workers=500, population=400)) as served, \
            dashboard(processes) as started, tab(browser) as page:  # fmt: skip
        page.goto(started.address)
        drawn(page, "Generation 4999")
        assert "Every 9th generation is drawn" in part(page, "fitness-caption")
        page.wait_for_selector(".workers tbody tr:nth-child(500)", state="attached")
        assert page.locator("[data-part=cells] .cell").count() == 400
        page.cdp = page.context.new_cdp_session(page)
        page.cdp.send("Performance.enable", {"timeDomain": "threadTicks"})
        began, painted = busy(page)
        for by in range(1, 6):
            fleet = enumerate(served.snapshot.workers)
            moved = [dataclasses.replace(each, steps_per_second=float((7 * n + 13 * by) % 900)) for n, each in fleet]
            served.snapshot = dataclasses.replace(served.snapshot, workers=tuple(moved))
            page.wait_for_function(  # asked rarely: the question is work of the page's own thread too
                "since => performance.getEntriesByName('update').length > since", arg=painted + by - 1, polling=200
            )
        ended, updates = busy(page)
        assert (ended - began) / (updates - painted) < 100, "milliseconds an update"


@pytest.mark.slow
def test_the_token_is_asked_for_and_opens_the_page(browser, processes):
    with dashboard(processes, "--host", "0.0.0.0", "--token", TOKEN) as started, tab(browser) as page:
        address = started.address.replace("0.0.0.0", "127.0.0.1")
        page.goto(address)
        page.fill("input[name=token]", "not this one")
        with page.expect_navigation() as answer:
            page.click("button")
        assert answer.value.status == 401
        page.fill("input[name=token]", TOKEN)
        page.click("button")
        wait(page, "no coordinator")
        assert TOKEN not in page.url
        without_absence(page)  # a browser logs each 401


def test_what_cannot_be_served_is_one_line(processes):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        code, _, err = processes.call("dashboard", "--port", taken.getsockname()[1])
    assert (code, "--port" in err) == (1, True), err
    refused("--token", "dashboard", "--host", "0.0.0.0")
    refused("'No Run'", "dashboard", "--run", "No Run")


@pytest.mark.slow
def test_it_leaves_at_once_although_pages_are_open(processes):
    with dashboard(processes) as started:
        stream = urllib.request.urlopen(f"{started.address}live", timeout=DEADLINE)
        assert stream.readline().startswith(b"event: hello")
        assert "digest" in json.loads(stream.readline().removeprefix(b"data: "))
        started.popen.send_signal(signal.SIGTERM)
        assert started.popen.wait(DEADLINE) == 0
        with pytest.raises(urllib.error.URLError):
            urllib.request.urlopen(started.address, timeout=DEADLINE)


def send_to(port, request):
    """What the server says to these bytes until it closes the connection, or the head alone of what goes on."""
    with socket.create_connection(("127.0.0.1", port), timeout=DEADLINE) as connection:
        connection.sendall(request)
        said = b""
        while b"\r\n\r\n" not in said and (more := connection.recv(65536)):
            said += more
    return said


@pytest.mark.slow
def test_clients_that_are_no_browsers_neither_stop_it_nor_see_more(processes):
    with dashboard(processes) as started, ExitStack() as stack:
        port = int(started.address.split(":")[-1].strip("/"))
        host = b"\r\nHost: 127.0.0.1\r\n"
        half = [stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=DEADLINE)) for _ in range(50)]
        for each in half:
            each.sendall(b"GET / HTTP/1.1\r\nHost: 127")
        for request, code in (
            (b"GET / HTTP/1.1" + host + b"X: " + b"x" * 200_000, b"400"),
            (b"\x16\x03\x01\x02\x00\r\n\r\n", b"400"),
            (b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n", b"421"),
            (b"POST / HTTP/1.1" + host + b"Content-Length: 1000000000\r\n\r\n", b"405"),
            (b"OPTIONS * HTTP/1.1" + host + b"\r\n", b"405"),
            (b"HEAD /live HTTP/1.1" + host + b"\r\n", b"200"),
            (b"GET /files/../../../../../../../../../../../etc/passwd HTTP/1.1" + host + b"\r\n", b"404"),
            (b"GET /files/x/%2e%2e%2f%2e%2e%2fguard.py HTTP/1.1" + host + b"\r\n", b"404"),
            (b"GET //etc/passwd HTTP/1.1" + host + b"\r\n", b"404"),
            (b"GET /view?run=%00%0d%0aX:1 HTTP/1.1" + host + b"\r\n", b"400"),
        ):
            said = send_to(port, request)
            assert said.split()[1:2] == [code], (request[:60], said[:200])
            assert b"root:" not in said
        assert all(each.recv(1) == b"" for each in half), "half a request is not waited for"
        with urllib.request.urlopen(started.address, timeout=DEADLINE) as answer:
            assert answer.status == 200
