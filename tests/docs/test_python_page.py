"""Every snippet of docs/reference/python.md runs, in order, and the page names all public names."""

import re

import pytest

import dreamfleet
from tests.support.processes import ROOT

PAGE = (ROOT / "docs" / "reference" / "python.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.slow
def test_the_snippets_run_in_order(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pandas")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    names = {"__name__": "__main__"}
    for number, snippet in enumerate(SNIPPETS):
        exec(compile(snippet, f"snippet {number}", "exec"), names)
    said = capsys.readouterr().out
    assert "<Run early of gym:CartPole-v1: " in said
    assert "\n12 generations\n" in said
    assert "<Controller of gym:CartPole-v1: 10 parameters" in said
    assert (tmp_path / "pole.png").stat().st_size > 1000


def test_the_page_names_what_is_public():
    table = PAGE[PAGE.index("## Names") :]
    assert sorted(re.findall(r"`(\w+)`", table)) == sorted(dreamfleet.__all__)
