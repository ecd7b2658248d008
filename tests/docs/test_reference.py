"""The generated pages of docs/reference are those that the code gives today; the hand-written tables are whole."""

import re

import pytest

from deploy import reference
from dreamfleet.common.cli.global_config import TABLES
from dreamfleet.common.monitoring.prometheus import collect_metrics
from tests.support.samples import STATUS


@pytest.mark.parametrize("page", ["verbs.md", "settings.md"])
def test_a_generated_page_is_up_to_date(page):
    assert (reference.FOLDER / page).read_text() == reference.pages()[page], "run `make reference`"


def test_every_table_of_the_configuration_file_is_described():
    assert reference.SECTIONS.keys() == {"", *TABLES}


def test_each_unit_is_of_a_setting():
    known = {
        f"{table}.{each.name}"
        for table, (section, _) in reference.SECTIONS.items()
        for each in reference._settings(section)
    }
    assert reference.UNITS.keys() <= known


def test_every_metric_is_described():
    page = (reference.FOLDER / "metrics.md").read_text()
    rows = {
        name: (kind, text)
        for name, kind, text in re.findall(r"^\| `(\w+)`[^|]*\| (\w+) \| (.*?) \|", page, re.MULTILINE)
    }
    assert rows == {each.name: (each.kind, each.text) for each in collect_metrics(STATUS)}
