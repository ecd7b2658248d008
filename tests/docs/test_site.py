"""`make site` builds all documents, with no dead link, and what it builds loads nothing from elsewhere."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.processes import DEADLINE, ROOT

LOADED = re.compile(r"<(?:script|link|img|iframe|source)\b[^>]*?\b(?:src|href)=\"?(?:https?:)?//[^\s>]*")
# What a page names for search engines and loads no more than any other link.
NAMED = re.compile(r"<link\b[^>]*\brel=\"?canonical")


def test_every_document_stands_in_the_navigation():
    listed = set(re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    there = {
        str(path.relative_to(ROOT)) for part in ("*.md", "docs/**/*.md", "deploy/*.md") for path in ROOT.glob(part)
    }
    assert there - listed == set(), "name it under `nav` in mkdocs.yml"
    assert listed - there == set(), "`nav` in mkdocs.yml names what is not there"


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
