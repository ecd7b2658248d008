"""What is recorded of the shipped controllers is of these controllers, and what the page says is what was recorded."""

import subprocess

import pytest

from dreamfleet.common.runs.evaluation_report import read_evaluation_report
from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
from dreamfleet.common.runs.seeds import TEST
from tests.support.processes import DEADLINE, ROOT

RECORDS = sorted((ROOT / "docs" / "results").glob("*.json"))


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_a_record_is_of_a_controller_that_ships_and_the_page_tells_it(path, tmp_path):
    found = read_evaluation_report(path)
    controller, _ = find_controller(found.name, tmp_path)
    assert (found.name, found.controller) == (path.stem, controller.sha256)
    assert found.bundle == find_bundle_of(controller, None).sha256
    assert set(found.results.seeds) <= set(TEST)
    assert f"{found.results.mean:.1f} ± {found.results.error:.1f}" in (ROOT / "docs" / "results.md").read_text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("reproduce",), " reproduce " + " ".join(f"docs/results/{path.name}" for path in RECORDS)),
        (("reproduce", "REPRODUCE=tiny"), " reproduce docs/results/tiny.json"),
        (("reproduce-evolution",), "reproduce_evolution.py tiny"),
        (("reproduce-evolution", "REPRODUCE=real"), "reproduce_evolution.py real"),
    ],
)
def test_make_names_what_is_had_again(words, said):
    done = subprocess.run(
        ["make", "--dry-run", *words], cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE, check=True
    )
    assert said in done.stdout
