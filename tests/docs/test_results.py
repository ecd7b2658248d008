"""Recorded results belong to the shipped controllers, and the page repeats them."""

import json
import subprocess

import pytest

from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
from dreamfleet.common.runs.seeds import TEST
from dreamfleet.worker.addons.evaluation.evaluation_report import read_evaluation_report
from tests.support.processes import ROOT

RECORDS = sorted((ROOT / "docs" / "lab" / "results").glob("*.json"))


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_a_record_is_of_a_shipped_controller_and_the_page_has_its_figures(path, tmp_path):
    found = read_evaluation_report(path)
    controller, _ = find_controller(found.name, tmp_path)
    assert (found.name, found.controller) == (path.stem, controller.sha256)
    assert found.bundle == find_bundle_of(controller, None).sha256
    assert set(found.results.seeds) <= set(TEST)
    assert f"{found.results.mean:.1f} ± {found.results.error:.1f}" in (ROOT / "docs" / "lab" / "results.md").read_text()
    plain = json.loads(path.read_text())
    assert {name: plain[name] for name in ("std", "error")} == pytest.approx(
        {"std": found.results.std, "error": found.results.error}
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("reproduce", " verify report " + " ".join(f"docs/lab/results/{path.name}" for path in RECORDS)),
        ("reproduce REPRODUCE=tiny", " verify report docs/lab/results/tiny.json"),
        ("reproduce-evolution", "reproduce_evolution.py tiny"),
        ("reproduce-evolution REPRODUCE=real", "reproduce_evolution.py real"),
    ],
)
def test_make_names_the_run_to_reproduce(words, said):
    assert said in subprocess.check_output(["make", "--dry-run", *words.split()], cwd=ROOT, text=True)
