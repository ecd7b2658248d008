import logging

from dreamfleet.common.host.error_counter import MAX_LOGGED_CHARS, ErrorCounter

log = logging.getLogger("dreamfleet.test")


def raised(error):
    try:
        raise error
    except Exception as caught:
        return caught


def test_each_reason_is_counted_and_logged_ever_more_rarely(caplog):
    error_counter = ErrorCounter(log)
    for _ in range(9):
        error_counter.record("beat", raised(KeyError("x")), "an event")
    error_counter.record("beat", raised(ValueError("y")), "an event")
    assert error_counter.counts == {"beat that raised KeyError": 9, "beat that raised ValueError": 1}
    assert len(caplog.records) == 4 + 1


def test_logged_events_are_short_and_printable(caplog):
    ErrorCounter(log).record("hello", raised(ValueError("\x1b[2J" * 500)), "\x1b]0;title\x07" * 500)
    (line,) = (record.getMessage() for record in caplog.records)
    assert line.isprintable()
    assert len(line) < 3 * MAX_LOGGED_CHARS
    assert "test_error_counter.py" in line
