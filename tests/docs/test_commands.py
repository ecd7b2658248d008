"""The commands of pages name verbs and flags that are there, and CONTRIBUTING's programs are those that tests need."""

import re
import shlex

import pytest

from tests.support import programs
from tests.support.processes import ROOT
from tests.support.programs import packages, require_programs

PARTS = ("README.md", "CONTRIBUTING.md", "docs/tutorials/*.md", "docs/how-to/*.md", "docs/explanation/*.md")
PAGES = sorted(path for part in PARTS for path in ROOT.glob(part))
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


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
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
