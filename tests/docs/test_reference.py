"""The generated pages of docs/reference are those that the code gives today; the hand-written tables are whole."""

import re

from deploy import reference
from dreamfleet.common.cli.global_config import TABLES
from dreamfleet.coordinator.addons.metrics.prometheus import collect_metrics
from tests.support.samples import STATUS


def test_generated_pages_and_the_types_of_a_runs_settings_are_up_to_date():
    for name, text in reference.pages().items():
        assert (reference.FOLDER / name).read_text() == text, "run `make reference`"
    assert reference.RUN_ARGUMENTS.read_text() == reference.run_arguments(), "run `make reference`"


def test_every_table_of_the_configuration_file_is_described_and_each_unit_is_of_a_setting():
    assert reference.SECTIONS.keys() == {"", *TABLES}
    sections = {table: section for table, (section, _) in reference.SECTIONS.items()}
    known = {f"{table}.{each.name}" for table in sections for each in reference._settings(sections[table])}
    assert reference.UNITS.keys() <= known


def test_every_metric_is_described():
    page = (reference.FOLDER / "metrics.md").read_text()
    rows = {
        name: (kind, text)
        for name, kind, text in re.findall(r"^\| `(\w+)`[^|]*\| (\w+) \| (.*?) \|", page, re.MULTILINE)
    }
    metrics = list(collect_metrics(STATUS))
    names = [f"{each.name}_total" if each.type == "counter" else each.name for each in metrics]
    assert rows == {name: (each.type, each.documentation) for name, each in zip(names, metrics, strict=True)}
