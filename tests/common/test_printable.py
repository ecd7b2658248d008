import pytest

from dreamfleet.common.printable import printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain, ümläuts and 雪", "plain, ümläuts and 雪"),
        ("boom \x1b[31mred", "boom \\x1b[31mred"),
        ("\x1b]0;title\x07", "\\x1b]0;title\\x07"),
        ("two\nlines", "two\\nlines"),
        ("\u202eback", "\\u202eback"),
    ],
)
def test_what_a_terminal_would_obey_is_written_out(text, shown):
    assert printable(text) == shown
