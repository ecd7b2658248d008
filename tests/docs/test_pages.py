"""Links in pages work, and `make site` builds all pages, which load nothing from elsewhere."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.processes import DEADLINE, ROOT

PAGES = sorted(path for pages in ("*.md", "docs/**/*.md", "deploy/*.md") for path in ROOT.glob(pages))
LOADED = re.compile(r"<(?:script|link|img|iframe|source)\b[^>]*?\b(?:src|href)=\"?(?:https?:)?//[^\s>]*")
# What a page names for search engines and loads no more than any other link.
NAMED = re.compile(r"<link\b[^>]*\brel=\"?canonical")


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_page_leads_to_what_is_there(page):
    named = re.findall(r"\]\((?!https?:|#)([^)#\s]+)", page.read_text())
    assert not [name for name in named if not (page.parent / name).exists()]
    named = re.findall(r"\]\((?!https?:)([^)#\s]*\.md|)#([^)\s]+)\)", page.read_text())
    targets = [(page.parent / name if name else page, anchor) for name, anchor in named]
    assert not [(target.name, anchor) for target, anchor in targets if anchor not in anchors(target)]


def anchors(page):
    """The names of a page's headings, as code hosts and the site make them."""
    found: list[str] = []
    for heading in re.findall(r"^#+ (.+)$", re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S), re.M):
        shown = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        found.append(re.sub(r"[^\w\- ]", "", shown.strip().lower()).replace(" ", "-"))
    return found


def test_every_page_stands_in_the_sites_navigation():
    listed = set(re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    assert {str(page.relative_to(ROOT)) for page in PAGES} == listed, "the list under `nav` in mkdocs.yml"


@pytest.mark.slow
def test_the_site_builds_strictly_and_works_without_a_network():
    pytest.importorskip("material", reason="needs the extra docs")
    words = ("make", "--old-file", ".venv/.docs", "site", f"BIN={Path(sys.executable).parent}")
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    site = ROOT / "build" / "site"
    pages = sorted(site.rglob("*.html"))
    assert {"index.html", "docs/tutorials/first-drive.html"} <= {str(page.relative_to(site)) for page in pages}
    for page in pages:
        assert [each for each in LOADED.findall(page.read_text()) if not NAMED.match(each)] == [], page
    assert "fonts.g" + "oogleapis" not in "".join(path.read_text() for path in site.rglob("*.css"))
    assert (site / "search").is_dir()
