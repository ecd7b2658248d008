import dataclasses
import re

import nbformat
import pytest
from nbclient import NotebookClient

from dreamfleet.common.addons.status_card import MOST_WORKERS, fitness_chart, show_live
from tests.support.large_status import LARGE
from tests.support.processes import DEADLINE, ROOT
from tests.support.samples import STATUS

SHOWN = """
import dreamfleet
run = dreamfleet.start_run(
    run="pole", task="gym:CartPole-v1", population=6, episodes=4, generations=60, evaluate_every=0, workers=1,
)
run.show(pause=0.1)
print(run.ended)
"""


def test_the_card_has_progress_fitness_and_workers():
    card = LARGE._repr_html_()
    assert "generation 7" in card
    assert card.count("<svg") == card.count("</svg>") == 1
    assert card.count("<tr>") == MOST_WORKERS
    assert "and 28 more" in card
    assert "<script" not in card


def test_what_others_write_is_escaped():
    worker = dataclasses.replace(STATUS.worker_list[0], worker="<b>x/1")
    card = dataclasses.replace(STATUS, run="<i>", worker_list=(worker,))._repr_html_()
    assert "<i>" not in card
    assert "&lt;b&gt;x" in card


def test_a_chart_stays_within_its_picture_whatever_the_fitness():
    rows = [dataclasses.replace(STATUS.recent[0], number=number, mean=value, best=value, worst=value)
            for number, value in enumerate((-1e90, 0.0, 1e90))]  # fmt: skip
    assert "from the second" in fitness_chart(rows[:1])
    for some in (rows, [dataclasses.replace(each, mean=1.0, best=1.0, worst=1.0) for each in rows]):
        numbers = re.findall(r"[\d.]+,[\d.]+", fitness_chart(some))
        assert len(numbers) == 9
        assert all(0 <= float(value) <= 560 for pair in numbers for value in pair.split(","))


def test_a_terminal_gets_a_line_of_each_until_an_interrupt(capsys):
    def statuses():
        yield from (STATUS, STATUS)
        raise KeyboardInterrupt

    show_live(statuses())
    assert capsys.readouterr().out.count("<Status of night") == 2


@pytest.mark.slow
def test_a_notebook_shows_a_run_in_one_place_until_it_ends(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(SHOWN)])
    NotebookClient(notebook, timeout=DEADLINE, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output for output in notebook.cells[0].outputs if output.output_type == "display_data"]
    assert len(shown) == 1
    card = shown[0]["data"]["text/html"]
    assert "ended: 60 generations" in card
    assert "<polyline" in card
    text = "".join(output.get("text", "") for output in notebook.cells[0].outputs)
    assert text.strip().endswith("60 generations")
