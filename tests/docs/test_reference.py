"""The generated pages of docs/reference are those that the code gives today; tables and results are true."""

import json
import re
import subprocess
from typing import Unpack, get_type_hints

import pytest

import dreamfleet
from deploy import reference
from dreamfleet.common.addons.evaluation_report import read_evaluation_report
from dreamfleet.common.cli.global_config import TABLES
from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
from dreamfleet.common.runs.seeds import TEST
from dreamfleet.coordinator.addons.metrics.prometheus import collect_metrics
from dreamfleet.experiments.local.run_arguments import RunArguments
from tests.support.processes import ROOT
from tests.support.samples import STATUS


@pytest.mark.wording
def test_generated_pages_and_the_types_of_a_runs_settings_are_up_to_date():
    for name, text in reference.pages().items():
        assert (reference.FOLDER / name).read_text() == text, "run `make reference`"
    assert reference.RUN_ARGUMENTS.read_text() == reference.run_arguments(), "run `make reference`"


def test_every_table_of_the_configuration_file_is_described_and_each_unit_is_of_a_setting():
    assert reference.SECTIONS.keys() == {"", *TABLES}
    sections = {table: section for table, (section, _) in reference.SECTIONS.items()}
    known = {f"{table}.{each.name}" for table in sections for each in reference._settings(sections[table])}
    assert reference.UNITS.keys() <= known


@pytest.mark.wording
def test_every_metric_is_described():
    page = (reference.FOLDER / "metrics.md").read_text()
    rows = {
        name: (kind, text)
        for name, kind, text in re.findall(r"^\| `(\w+)`[^|]*\| (\w+) \| (.*?) \|", page, re.MULTILINE)
    }
    metrics = list(collect_metrics(STATUS))
    names = [f"{each.name}_total" if each.type == "counter" else each.name for each in metrics]
    assert rows == {name: (each.type, each.documentation) for name, each in zip(names, metrics, strict=True)}


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


@pytest.mark.parametrize("function", [dreamfleet.start_run, dreamfleet.evolve])
def test_what_starts_a_run_takes_typed_settings(function):
    assert get_type_hints(function)["settings"] == Unpack[RunArguments]
