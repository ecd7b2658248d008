"""Links and commands of pages work, `make site` builds all pages, and citation and issue templates are of this version.
Tests coordinator/addons/runs/citation.py."""

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
from packaging.version import Version

from deploy.check_wheel import dead_links
from dreamfleet.common.cli.command_line import build_parser
from dreamfleet.coordinator.addons.runs.citation import AUTHORS
from tests.support import programs
from tests.support.processes import DEADLINE, ROOT
from tests.support.programs import packages, require_programs
from tests.support.verbs import find_verb

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


CITATION = ROOT / "CITATION.cff"
TEMPLATES = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.md"))


def test_the_citation_is_valid_of_this_version_and_of_the_same_authors_as_receipts_say():
    checker = Path(sys.executable).parent / "check-jsonschema"
    subprocess.run([checker, "--builtin-schema", "vendor.citation-file-format", CITATION], check=True, timeout=DEADLINE)
    text = CITATION.read_text()
    assert f"version: {Version(version('dreamfleet')).base_version}\n" in text
    assert f"- name: {AUTHORS}\n" in text
    assert "dreamfleet runs receipt" in text


@pytest.mark.parametrize("template", TEMPLATES, ids=lambda path: path.stem)
def test_a_template_asks_for_what_can_be_typed(template):
    text = template.read_text()
    assert re.match(r"---\nname: .+\nabout: .+\n---\n", text)
    commands = [line.split()[1:] for line in re.findall(r"^dreamfleet .*$", text, re.MULTILINE)]
    typed = [words for words in commands if words != ["…"]]
    assert typed
    for words in typed:
        name, verb, rest = find_verb(words)
        build_parser(name, verb).parse_all([word.replace("GENERATION/NUMBER", "3/0") for word in rest])
    for page in re.findall(r"`(docs/[\w/.-]+)`", text):
        assert (ROOT / page).exists()


PARTS = ("README.md", "CONTRIBUTING.md", "docs/tutorials/*.md", "docs/how-to/*.md", "docs/explanation/*.md")
PAGES_OF_COMMANDS = sorted(path for part in PARTS for path in ROOT.glob(part))
GROUPS = ("access", "baseline", "lab", "runs", "verify")
VERBS, SETTINGS = ((ROOT / "docs" / "reference" / name).read_text() for name in ("verbs.md", "settings.md"))
EVERY = "\n".join(re.findall(r"^\| .*", VERBS.partition("\n## ")[0], re.MULTILINE))  # flags of every verb
FLAGS = dict(re.findall(r"^### (.+?)\n(.*?)(?=^##|\Z)", VERBS, re.MULTILINE | re.DOTALL))


def commands(page):
    """The words of each `dreamfleet` line in a page's shell blocks, but for the program and `&`."""
    for block in re.findall(r"^ *```sh\n(.*?)^ *```", page.read_text(), re.MULTILINE | re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            if line.lstrip().startswith("dreamfleet "):
                yield [word for word in shlex.split(line, comments=True)[1:] if word != "&"]


@pytest.mark.parametrize("page", PAGES_OF_COMMANDS, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_pages_commands_are_there(page):
    wrong = []
    for words in commands(page):
        verb = " ".join(words[: 2 if words[0] in GROUPS else 1])
        known = f"{EVERY}{FLAGS.get(verb, '')}"
        names = [word.partition("=")[0] for word in words if word.startswith("--")]
        flags = [name for name in names if " " not in name]  # a text of several flags is another verb's
        wrong += [verb] * (verb not in FLAGS and verb != "VERB")
        wrong += [
            f"{verb} {flag}"
            for flag in flags
            if not re.search(rf"{re.escape(flag)}\b", known) and f"`{flag[2:].replace('-', '_')}`" not in SETTINGS
        ]
    assert wrong == [], "docs/reference/verbs.md has the verbs and their flags"


def test_contributing_installs_the_packages_of_the_list():
    (names,) = re.findall(
        r"^apt-get install --no-install-recommends (.*)", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE
    )
    assert names.split() == sorted(packages().values())


def test_without_a_program_a_test_is_skipped_for_a_reason_that_all_share_and_fails_in_ci(monkeypatch):
    monkeypatch.setattr(programs, "SEARCHED", "/nowhere")
    for in_ci, outcome in (("", pytest.skip.Exception), ("true", pytest.fail.Exception)):
        monkeypatch.setenv("CI", in_ci)
        for name in packages():
            with pytest.raises(outcome, match=re.escape(" ".join(packages().values()))):
                require_programs(name)


SHIPPED = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


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


@pytest.mark.parametrize("page", SHIPPED, ids=lambda page: page.name)
def test_a_line_that_installs_takes_a_wheels_file_here_or_the_index(page):
    lines = [line for line in page.read_text().splitlines() if re.search(r"pip install .*dreamfleet\[", line)]
    shown = [line for line in lines if not re.search(r"^missing |^\||`[^`]*: pip install", line)]
    assert all("--find-links . 'dreamfleet[" in line for line in shown)
    if any("[train" in line for line in shown):
        assert "5.4 GB on disk" in page.read_text()


@pytest.mark.parametrize("words", [["setup.py", "--name"], ["-c", "import dreamfleet"]])
def test_a_clone_without_links_stops_and_names_the_setting(words, tmp_path):
    def run():
        return subprocess.run([sys.executable, *words], cwd=tmp_path, capture_output=True, text=True, check=False)

    link = tmp_path / "dreamfleet" / "common"
    link.parent.mkdir()
    link.write_text("../common")
    for name in ("setup.py", "dreamfleet/__init__.py"):
        shutil.copy(ROOT / name, tmp_path / name)
    stopped = run()
    assert stopped.returncode == 1
    assert "core.symlinks" in stopped.stderr.splitlines()[-1]
    link.unlink()
    link.mkdir()
    assert run().returncode == 0


def test_each_extra_that_a_text_names_exists():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    texts = [*ROOT.glob("docs/**/*.md"), ROOT / "README.md", ROOT / "tests" / "golden" / "messages.txt"]
    for folder in ("common", "coordinator", "worker", "dreamfleet", "deploy"):
        texts += (ROOT / folder).rglob("*.py")
    named = {
        (name, str(path.relative_to(ROOT)))
        for path in texts for names in re.findall(r"\bdreamfleet\[([\w, -]+)\]", path.read_text())
        for name in names.split(",")
    }  # fmt: skip
    assert {each for each in named if each[0].strip() not in extras} == set()
