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


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(HERE)))
def test_a_link_to_a_heading_leads_to_one(page):
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
