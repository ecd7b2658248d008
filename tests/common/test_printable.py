import numpy as np

from dreamfleet.common.printable import format_setting, plural, printable


def test_control_characters_are_escaped():
    assert printable("plain, ümläuts and 雪") == "plain, ümläuts and 雪"
    assert printable("\x1b[31mred\x1b]0;title\x07") == "\\x1b[31mred\\x1b]0;title\\x07"
    assert printable("two\nlines, \u202eback") == "two\\nlines, \\u202eback"


def test_plurals():
    texts = plural(1, "seed"), plural(1000, "seed"), plural(1.0, "minute"), plural(1.5, "minute")
    assert plural(np.int64(1_000_000), "step") == "1,000,000 steps"
    assert (*texts, plural(2, "batch", "batches")) == ("1 seed", "1,000 seeds", "1 minute", "1.5 minutes", "2 batches")


def test_settings_are_formatted():
    settings = (True, False, ("numpy", "cma"), 0.1, -0.0)
    assert [format_setting(each) for each in settings] == ["yes", "no", "numpy, cma", "0.1", "0"]
