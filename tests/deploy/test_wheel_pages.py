"""The pages that ship: their links lead to what ships too, and their lines that install work with a wheel's file."""

import re
import shutil
import tomllib
from pathlib import Path

import pytest

from deploy.check_wheel import dead_links

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def test_each_link_of_a_page_that_ships_leads_to_what_ships(tmp_path):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    for pattern in project["tool"]["setuptools"]["package-data"]["dreamfleet"]:
        for path in ROOT.glob(pattern):
            target = tmp_path / path.relative_to(ROOT)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)
    assert len(list(tmp_path.rglob("*.md"))) > 50
    assert dead_links(tmp_path) == []


def test_a_dead_link_is_found_and_a_live_or_foreign_one_is_not(tmp_path):
    folder = tmp_path / "pages"
    (folder / "a").mkdir(parents=True)
    (tmp_path / "outside.md").touch()
    (folder / "a" / "b.md").write_text(
        "[x](../c.md#top) [y](https://example.com) [z](#here) ![p](gone.png)\n"
        "[o](../../outside.md)\n```\n[n](no.md)\n```\n"
    )
    (folder / "c.md").touch()
    assert dead_links(folder) == ["a/b.md: gone.png", "a/b.md: ../../outside.md"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_line_that_installs_takes_a_wheels_file_here_or_the_index(page):
    lines = [line for line in page.read_text().splitlines() if re.search(r"pip install .*dreamfleet\[", line)]
    shown = [line for line in lines if not re.search(r"^missing |^\||`[^`]*: pip install", line)]
    assert all("--find-links . 'dreamfleet[" in line for line in shown)
    if any("[train" in line for line in shown):
        assert "5.4 GB on disk" in page.read_text()
