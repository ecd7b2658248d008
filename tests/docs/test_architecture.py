"""architecture.md names rooms, files and classes that are there, and code cites the rules that protocol.md has."""

import ast
import re

from deploy.structure import ROOT, SIDES, sources

PAGE = ROOT / "docs" / "explanation" / "architecture.md"
MOST_WORDS = 1300
NO_ROOM = {"__pycache__", "pretrained"}  # `pretrained` holds files that ship, and no code


def rooms_on_the_page() -> dict[str, set[str]]:
    parts = re.split(r"^\*\*([\w/]+)/\*\*", PAGE.read_text(), flags=re.MULTILINE)
    tables = zip(parts[1::2], parts[2::2], strict=True)
    return {side: set(re.findall(r"^\| `(\w+)/` \|", text, re.MULTILINE)) for side, text in tables}


def test_each_room_has_its_row():
    rooms = {side: {path.name for path in (ROOT / side).iterdir() if path.is_dir()} - NO_ROOM for side in SIDES}
    assert rooms_on_the_page() == rooms


def test_what_it_names_exists():
    defined = {
        node.name
        for path in sources(*SIDES)
        for node in ast.walk(ast.parse((ROOT / path).read_text()))
        if isinstance(node, (ast.ClassDef, ast.FunctionDef))
    }
    words = re.findall(r"`([^`]+)`", PAGE.read_text())
    paths = [
        word for word in words if re.fullmatch(r"(common|coordinator|worker|deploy|dreamfleet|tests)/[\w/.]*", word)
    ]
    names = [word for word in words if re.fullmatch(r"[A-Z]\w+(\.\w+)?", word)]
    assert [path for path in paths if not (ROOT / path).exists()] == []
    assert [name for name in names if not set(name.split(".")) <= defined] == []
    assert paths
    assert names


def test_it_stays_short():
    assert len(PAGE.read_text().split()) <= MOST_WORDS


def test_the_protocols_rules_are_numbered_without_a_gap_and_code_serves_each_one():
    page = (ROOT / "docs/reference/protocol.md").read_text()
    rules = [int(number) for number in re.findall(r"^- \*\*R(\d+)\. ", page, re.MULTILINE)]
    assert rules == list(range(1, len(rules) + 1))
    citation = re.compile(r"\bR(\d+)(?=[:,)]| and R\d)")
    cited = {int(each): str(path) for path in sources(*SIDES) for each in citation.findall((ROOT / path).read_text())}
    assert {number: path for number, path in cited.items() if number not in rules} == {}
    assert set(rules) - cited.keys() == set()
