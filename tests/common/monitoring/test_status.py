"""The status document: golden, forgiving towards later versions, clear about what it cannot read."""

import dataclasses
import json
from pathlib import Path

import pytest

from dreamfleet.common.monitoring.status import Candidate, read_document, read_status
from dreamfleet.common.protocol.codec import encode_json
from dreamfleet.common.protocol.host_classes import HostClasses, HostClassShare
from dreamfleet.common.serialization.validation import MalformedError
from dreamfleet.common.verbs.status import print_runs
from tests.support.samples import STATUS

GOLDEN = Path(__file__).parents[1] / "golden" / "status.v2.json"


def test_the_golden_status_is_read_for_ever():
    assert read_status(read_document(GOLDEN.read_bytes())) == STATUS


def test_what_is_written_today_reads_as_what_was_written():
    assert read_status(read_document(encode_json(STATUS))) == STATUS
    assert json.loads(encode_json(STATUS)) == json.loads(GOLDEN.read_bytes())


def test_fields_of_later_versions_are_ignored_at_any_depth():
    document = json.loads(GOLDEN.read_bytes())
    later = {"later": {"anything": [1]}}
    document |= later
    for part in (document["settings"], document["settings"]["task"], document["worker_list"][0], document["waste"],
                 document["population"], document["recent"][0], document["best"]):  # fmt: skip
        part.update(later)
    assert read_status(document) == STATUS


@pytest.mark.parametrize("missing", ["waste", "population", "worker_list", "recent"])
def test_a_missing_field_is_an_error_that_names_what_to_install(missing):
    document = json.loads(GOLDEN.read_bytes())
    del document[missing]
    with pytest.raises(MalformedError, match=r"run night .* install the coordinator's dreamfleet \(0\.1\.0\) here"):
        read_status(document)


def test_the_first_schema_is_refused_with_its_number():
    with pytest.raises(MalformedError, match=r"schema 1, not 2"):
        read_status({"schema": 1, "run": "night", "package": "0.0.9", "state": "running"})


@pytest.mark.parametrize("payload", [b"", b"[]", b"\xff", b"{" * 20000, b"1"])
def test_what_is_no_document_is_an_error_for_people(payload):
    with pytest.raises(MalformedError, match="install the same dreamfleet"):
        read_document(payload)


def test_a_population_is_columns_on_the_wire_and_rows_to_a_reader():
    population = dataclasses.replace(STATUS.population, offset=4)
    assert population.candidates[1] == Candidate(7, 5, 1, 2, -3.25)
    assert population.candidates[2].fitness is None


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("evaluation", "episodes"), 0),
        (("best", "episodes"), -1),
        (("population", "done"), [1]),
    ],
)
def test_what_nothing_can_be_computed_of_is_malformed(path, value):
    document = json.loads(GOLDEN.read_bytes())
    document[path[0]][path[1]] = value
    with pytest.raises(MalformedError):
        read_status(document)


def test_a_number_of_more_digits_than_a_message_can_hold_is_malformed():
    with pytest.raises(MalformedError):
        read_document(b'{"limits": {"generations": 1%s}}' % (b"0" * 400))
    assert read_document(b'{"limits": {"generations": 18446744073709551615}}')


def test_classes_without_names_or_results_are_told():
    assert HostClasses(total=1).description == "no result yet"
    assert HostClasses(2, (HostClassShare("a" * 16, 0, ()),), 0).description.startswith("mixed: 2 classes")


if __name__ == "__main__" and not GOLDEN.exists():
    GOLDEN.write_bytes(encode_json(STATUS))


def test_of_several_runs_one_that_answers_with_nonsense_is_a_note_and_the_others_are_told(capsys):
    first, other, liar = (json.loads(encode_json(dataclasses.replace(STATUS, run=run))) for run in ("b", "a", "liar"))
    print_runs([first, liar | {"evaluations": -1}, other])
    told = capsys.readouterr()
    assert [line.split()[0] for line in told.out.splitlines() if line.split()[0] in {"a", "b", "liar"}] == ["a", "b"]
    assert "liar" in told.err
    assert "2 live runs" in told.err
