import dataclasses
import json
from pathlib import Path

import pytest

from dreamfleet.common.client.status import Candidate, read_document, read_status
from dreamfleet.common.protocol.codec import encode_json
from dreamfleet.common.protocol.host_classes import HostClasses, HostClassShare
from dreamfleet.common.schema.validation import MalformedError
from dreamfleet.coordinator.addons.status.verb import print_runs
from tests.support.samples import STATUS

GOLDEN = Path(__file__).parents[1] / "golden" / "status.v2.json"


def test_the_golden_status_is_read_and_written():
    assert read_status(read_document(GOLDEN.read_bytes())) == STATUS
    assert json.loads(encode_json(STATUS)) == json.loads(GOLDEN.read_bytes())


def test_fields_of_later_versions_are_ignored_at_any_depth():
    document = json.loads(GOLDEN.read_bytes())
    later = {"later": {"anything": [1]}}
    document |= later
    for part in (document["settings"], document["settings"]["task"], document["worker_list"][0], document["waste"],
                 document["population"], document["recent"][0], document["best"]):  # fmt: skip
        part.update(later)
    assert read_status(document) == STATUS


def test_the_error_for_a_missing_field_or_a_value_out_of_range_names_the_version_to_install():
    odd = {("evaluation", "episodes"): 0, ("best", "episodes"): -1, ("population", "done"): [1], ("waste",): None}
    for (part, *field), value in odd.items():
        document = json.loads(GOLDEN.read_bytes())
        if field:
            document[part][field[0]] = value
        else:
            del document[part]
        with pytest.raises(MalformedError, match=r"night .*0\.1\.0"):
            read_status(document)
    with pytest.raises(MalformedError, match=r"1.* 2"):  # the first schema
        read_status({"schema": 1, "run": "night", "package": "0.0.9", "state": "running"})


def test_a_population_has_columns_and_rows_and_host_classes_need_no_names():
    population = dataclasses.replace(STATUS.population, offset=4)
    assert population.candidates[1] == Candidate(7, 5, 1, 2, -3.25)
    assert population.candidates[2].fitness is None
    assert HostClasses(total=1).description
    assert "2" in HostClasses(2, (HostClassShare("a" * 16, 0, ()),), 0).description


MANY_DIGITS = b'{"limits": {"generations": 1%s}}' % (b"0" * 400)


@pytest.mark.parametrize("payload", [b"", b"[]", b"\xff", b"{" * 20000, b"1", MANY_DIGITS])
def test_an_invalid_document_is_a_readable_error(payload):
    with pytest.raises(MalformedError):
        read_document(payload)
    assert read_document(b'{"limits": {"generations": 18446744073709551615}}')


if __name__ == "__main__" and not GOLDEN.exists():
    GOLDEN.write_bytes(encode_json(STATUS))


def test_one_invalid_reply_among_several_runs_is_only_noted(capsys):
    first, other, liar = (json.loads(encode_json(dataclasses.replace(STATUS, run=run))) for run in ("b", "a", "liar"))
    print_runs([first, liar | {"evaluations": -1}, other])
    output = capsys.readouterr()
    assert [line.split()[0] for line in output.out.splitlines() if line.split()[0] in {"a", "b", "liar"}] == ["a", "b"]
    assert "liar" in output.err
    assert "2 live runs" in output.err
