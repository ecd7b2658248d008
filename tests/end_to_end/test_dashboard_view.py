"""The page's live view in a real browser: a process for what is watched, while somebody watches.

Tests coordinator/addons/dashboard/view_processes.py.
"""

import signal

import psutil
import pytest

from tests.support import tasks
from tests.support.browser import dashboard, tab, wait_for_text, wait_until

PICTURE = "[data-part=view-picture]:not([hidden])"
OTHER = "src => document.querySelector('[data-part=view-picture]').src !== src"
LATER = "before => [...document.querySelectorAll('[data-part=view-facts] div')].some(each => " \
        "each.textContent.startsWith('generation') && Number(each.lastChild.textContent) > Number(before))"  # fmt: skip
WHOM = "[data-part=view-whom]"
HIDE = "hidden => { Object.defineProperty(document, 'hidden', {value: hidden, configurable: true}); " \
       "document.dispatchEvent(new Event('visibilitychange')) }"  # fmt: skip


@pytest.fixture
def run(processes, small):
    """A run whose episodes are pictures, with a worker; its coordinator."""
    often = ("--evaluate-every", 1, "--evaluation-episodes", 1)
    coordinator = processes.coordinator(*small, "--task", tasks.PAINTED, "--population", 3, *often)
    coordinator.worker = processes.worker("--task", tasks.PAINTED, "--name", "alpha")
    return coordinator


def children(process):
    return psutil.Process(process.popen.pid).children()


def say(page, text, part="view-text"):
    wait_for_text(page, text, part)


def wait_for_end(page, *values):
    """Wait until the view offers to start again, and check that its text names `values`."""
    page.wait_for_selector("[data-part=view-again]:not([hidden])")
    text = page.inner_text("[data-part=view-text]")
    assert all(value in text for value in values), text


def choose(page, kind):
    """The first of the workers, or of the generations, once there is one."""
    option = page.wait_for_selector(f"{WHOM} option[value^={kind}]", state="attached")
    page.select_option(WHOM, option.get_attribute("value"))


def look(page):
    """Keep the view in sight, while charts above it take their places, until it shows a picture."""
    script = "document.querySelector('[data-part=view]').scrollIntoView({block: 'nearest'})"
    wait_until(page, f"picture => {{ {script}; return document.querySelector(picture) }}", PICTURE)


def facts(page):
    names, values = (page.locator(f"[data-part=view-facts] {each}").all_text_contents() for each in ("dt", "dd"))
    return dict(zip(names, values, strict=False))


@pytest.mark.slow
def test_pictures_come_with_their_facts_while_somebody_sees_them(browser, processes, run):
    with dashboard(processes) as started, tab(browser) as page, tab(browser) as other:
        page.goto(started.address)
        page.locator("[data-part=view]").scroll_into_view_if_needed()
        page.wait_for_selector(PICTURE)
        assert page.get_attribute(PICTURE, "src").startswith("data:image/jpeg;base64,/9j/")
        assert "the busiest worker" in page.get_attribute(PICTURE, "alt")
        assert facts(page)["worker"].startswith("alpha/")
        assert {"generation", "step", "score so far"} <= facts(page).keys()
        before = page.get_attribute(PICTURE, "src")
        wait_until(page, OTHER, before)
        other.goto(started.address)
        other.wait_for_selector(PICTURE)
        (only,) = children(started)
        only.kill()
        for each in (page, other):
            say(each, f" {signal.SIGKILL.value}")
            each.click("[data-part=view-again]")
            each.wait_for_selector("[data-part=view-again][hidden]", state="attached")
            each.wait_for_selector(PICTURE)
        other.goto("about:blank")
        (only,) = children(started)
        page.evaluate(HIDE, True)
        while children(started):
            page.wait_for_timeout(50)
        page.evaluate(HIDE, False)
        wait_until(page, OTHER, page.get_attribute(PICTURE, "src"))
        page.focus("[data-part=view-pause]")
        page.keyboard.press("Enter")
        assert page.inner_text("[data-part=view-pause]") == "Play"


@pytest.mark.slow
def test_a_task_without_pictures_takes_no_room_for_them(browser, processes, small):
    processes.coordinator(*small)
    processes.worker("--task", tasks.SLOW_TOY, "--name", "alpha")
    with dashboard(processes) as started, tab(browser) as page:
        page.goto(started.address)
        page.wait_for_selector("[data-part=view]:not([hidden])").scroll_into_view_if_needed()
        say(page, "Workers score this task without drawing it; `dreamfleet record` and `live` draw it.")
        assert facts(page)["worker"].startswith("alpha/")
        shown = facts(page)
        page.evaluate(HIDE, True)
        assert facts(page) == {}
        page.evaluate(HIDE, False)
        wait_until(page, LATER, shown["generation"])
        assert page.locator("[data-part=view]").bounding_box()["height"] < 300


@pytest.mark.slow
def test_a_worker_a_mean_and_an_earlier_generations_are_chosen_and_what_is_gone_is_said(browser, processes, run):
    with dashboard(processes, "--views", 1) as started, \
            tab(browser, viewport={"width": 390, "height": 844}, reduced_motion="reduce") as page:  # fmt: skip
        page.goto(started.address)
        say(page, "Paused")
        assert not children(started)
        choose(page, "worker")
        page.locator("[data-part=view-pause]").click()
        look(page)
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        with tab(browser) as other:
            other.goto(started.address)
            other.locator("[data-part=view]").scroll_into_view_if_needed()
            wait_for_end(other, "1")
        page.wait_for_selector(f"{WHOM} option[value^=generation]", state="attached")
        run.worker.popen.kill()
        wait_for_end(page, "alpha", "test")
        choose(page, "generation")
        wait_for_end(page)
        run.popen.kill()
        say(page, "lost", "state")
        page.select_option(WHOM, "best=")
        wait_for_end(page)
