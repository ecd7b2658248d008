"""The citation is valid and of this version; what the issue templates ask for can be typed.
Tests coordinator/addons/runs/citation.py."""

import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from packaging.version import Version

from dreamfleet.common.cli.command_line import build_parser
from dreamfleet.coordinator.addons.runs.citation import AUTHORS
from tests.support.processes import DEADLINE, ROOT
from tests.support.verbs import find_verb

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
