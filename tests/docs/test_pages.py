"""Links in pages work."""

import re
from pathlib import Path

import pytest

HERE = Path(__file__).parents[2]
PAGES = sorted(path for pages in ("*.md", "docs/**/*.md", "deploy/*.md") for path in HERE.glob(pages))


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(HERE)))
def test_a_page_leads_to_what_is_there(page):
    named = re.findall(r"\]\((?!https?:|#)([^)#\s]+)", page.read_text())
    assert not [name for name in named if not (page.parent / name).exists()]
