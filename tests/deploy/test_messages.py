"""Every message of the product stands in tests/golden/messages.txt; a key in its place keeps what is data."""

import ast

import pytest

from deploy.messages import catalogue, keyed
from tests.support.processes import ROOT

GOLDEN = ROOT / "tests" / "golden" / "messages.txt"
SAMPLE = '''
def check(count):
    """A docstring is no message."""
    if count == "no more than that here":
        raise UsageError(f"--population is {count} and should be 2 to {LIMIT}; omit --{name}; see `dreamfleet runs`")
    log.info("%d candidates were scored", count)
    raise BatchError("too large", f"a batch of {count} candidates is too large")
    return "SELECT what is there FROM all of them"
'''


@pytest.mark.wording
def test_each_message_is_in_the_catalogue():
    assert catalogue() == GOLDEN.read_text(), "the wording changed: `make messages`, and read the difference"


def test_a_key_keeps_flags_numbers_values_and_names():
    code = ast.unparse(keyed(ast.parse(SAMPLE), "sample"))
    assert "A docstring is no message." in code
    assert "no more than that here" in code
    assert "FROM all of them" in code
    assert "candidates" not in code
    for kept in ("--population", "{count}", "{LIMIT}", "--{name}", "`dreamfleet runs`", "%d", "'too large'"):
        assert kept in code
