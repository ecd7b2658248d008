"""A real browser, where there is one: Debian's Chromium without a screen."""

import shutil
from contextlib import contextmanager

import pytest

CHROMIUM = shutil.which("chromium")
PATIENCE = 45_000  # milliseconds: a busy machine is slow, and every wait ends as soon as it may


@contextmanager
def chromium():
    """One browser; the test is skipped without one."""
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("there is no chromium here")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@contextmanager
def tab(browser, **options):
    """A page in which nothing may go wrong unseen: what its console says fails the test."""
    context = browser.new_context(**{"viewport": {"width": 1280, "height": 900}, **options})
    context.set_default_timeout(PATIENCE)
    page, said = context.new_page(), []
    page.on("console", lambda message: said.append(message.text) if message.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.said = said
    yield page
    context.close()
    assert page.said == []
