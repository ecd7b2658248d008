"""A real headless browser: Debian's Chromium."""

from contextlib import contextmanager

from playwright.sync_api import sync_playwright

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
