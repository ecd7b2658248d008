import pytest

from dreamfleet.common.cli.command_line import main
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.schema.times import elapsed_seconds, format_time
from tests.support.journals import change_journal

ENDED = "2026-01-01T00:00:00+00:00"


def test_seconds_between_two_moments():
    for begun in ("2025-12-31T23:59:00+00:00", "2026-01-01T01:59:00+02:00"):
        assert elapsed_seconds(begun, ENDED) == 60.0
    set_back = "2026-01-02T00:00:00+00:00"
    for begun in (set_back, "9999-12-31T23:59:59-23:00", "", "yesterday"):
        assert elapsed_seconds(begun, ENDED) is None
    assert elapsed_seconds(ENDED, "") is None


def test_a_moment_for_people():
    assert format_time("2026-11-23T19:30:59+02:00") == "2026-11-23 17:30 UTC"
    odd = {"": "", "x\x1b": "x\\x1b", "9999-12-31T23:59:59-23:00": "9999-12-31T23:59:59-23:00"}
    assert [format_time(each) for each in odd] == [*odd.values()]


@pytest.mark.add_on
@pytest.mark.parametrize("begun", [None, "", "x", "1970-01-01T00:00:00", "9999-12-31T23:59:59-23:00"])
def test_every_verb_about_a_run_reads_its_odd_times(begun, runs, capsys):
    change_journal(runs / "reality", "INSERT OR REPLACE INTO run VALUES ('ended_at', ?)", ENDED)
    change_journal(runs / "reality", "DELETE FROM run WHERE key = 'created'")
    if begun is not None:
        change_journal(runs / "reality", "INSERT INTO run VALUES ('created', ?)", begun)
    known = begun == "1970-01-01T00:00:00"
    with RunFolder(runs / "reality") as run:
        assert (run.duration_seconds is not None) == known
    for words in ("list", "show reality", "show reality --json", "receipt reality", "receipt reality --json"):
        assert main(["runs", *words.split(), "--runs-dir", str(runs)]) == 0
    printed = capsys.readouterr().out
    assert ("year = {1970}" in printed) == known
    assert "-2." not in printed.partition("ended_at")[2].partition("\n")[0]
