import logging

from dreamfleet.common.mishaps import LONGEST, Mishaps

log = logging.getLogger("dreamfleet.test")


def raised(error):
    try:
        raise error
    except Exception as caught:
        return caught


def test_each_reason_is_counted_and_told_ever_more_rarely(caplog):
    mishaps = Mishaps(log)
    for _ in range(9):
        mishaps.note("beat", raised(KeyError("x")), "an event")
    mishaps.note("beat", raised(ValueError("y")), "an event")
    assert mishaps.counts == {"beat that raised KeyError": 9, "beat that raised ValueError": 1}
    assert len(caplog.records) == 4 + 1


def test_what_is_told_of_an_event_is_short_and_printable(caplog):
    Mishaps(log).note("hello", raised(ValueError("\x1b[2J" * 500)), "\x1b]0;title\x07" * 500)
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.isprintable()
    assert len(line) < 3 * LONGEST
    assert "test_mishaps.py" in line
