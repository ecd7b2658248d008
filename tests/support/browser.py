"""A real headless browser: Debian's Chromium."""

from contextlib import contextmanager

from playwright.sync_api import TimeoutError as SlowPageError
from playwright.sync_api import sync_playwright

from dreamfleet.common.host.reports import ADDRESS
from tests.support.processes import DEADLINE
from tests.support.programs import find_program, require_programs

PATIENCE = 1000 * DEADLINE  # milliseconds


@contextmanager
def chromium():
    """A browser; the test is skipped without one."""
    require_programs("chromium")
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=find_program("chromium"), args=["--no-sandbox"])
        yield browser
        browser.close()


@contextmanager
def tab(browser, **options):
    """A page whose console messages fail the test."""
    context = browser.new_context(**{"viewport": {"width": 1280, "height": 900}, **options})
    context.set_default_timeout(PATIENCE)
    page, said = context.new_page(), []
    page.on("console", lambda message: said.append(message.text) if message.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.said = said
    yield page
    context.close()
    assert page.said == []


@contextmanager
def dashboard(processes, *flags):
    """Its process, and the address that it printed."""
    where = ("--connect", processes.endpoint, "--runs-dir", processes.runs, "--port", 0)
    started = processes.start("dashboard", *where, *flags)
    started.address = started.wait_for_report(ADDRESS)
    yield started
    started.end()


def wait_for_text(page, text, part="state"):
    """Wait until the page has the text in this part."""
    script = "([part, text]) => document.querySelector(`[data-part=${part}]`)?.textContent.includes(text)"
    wait_until(page, script, [part, text])


def wait_until(page, script, arg):
    """Wait until the script says so, also without a frame."""
    try:
        page.wait_for_function(script, arg=arg, timeout=PATIENCE, polling=200)
    except SlowPageError as error:
        error.add_note(f"said: {page.said}; shown: {page.locator('body').inner_text()[:2000]}")
        raise
