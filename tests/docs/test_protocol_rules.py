"""The numbered rules of docs/reference/protocol.md: code cites no other, and each one is served somewhere."""

import re

from deploy.structure import ROOT, SIDES, sources

RULE = re.compile(r"^- \*\*R(\d+)\. ", re.MULTILINE)
CITATION = re.compile(r"\bR(\d+)(?=[:,)]| and R\d)")


def cited_rules() -> dict[int, list[str]]:
    cited: dict[int, list[str]] = {}
    for path in sources(*SIDES):
        for number in CITATION.findall((ROOT / path).read_text()):
            cited.setdefault(int(number), []).append(str(path))
    return cited


def test_the_rules_are_numbered_without_a_gap():
    rules = [int(number) for number in RULE.findall((ROOT / "docs/reference/protocol.md").read_text())]
    assert rules == list(range(1, len(rules) + 1))


def test_code_cites_rules_that_exist_and_serves_each_one():
    rules = {int(number) for number in RULE.findall((ROOT / "docs/reference/protocol.md").read_text())}
    cited = cited_rules()
    assert {number: paths for number, paths in cited.items() if number not in rules} == {}
    assert rules - cited.keys() == set()
