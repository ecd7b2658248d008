"""Every message of the product stands in tests/golden/messages.txt; a key in its place keeps what is data. No module
uses a loader that could execute the files of another party; Ruff forbids `eval` and `exec`.

`multiprocessing` pickles what passes between a process and the children that it started itself; nobody else reaches
those pipes. A task's or an optimiser's module is code that was installed here, or named on this host's command line.
"""

import ast
import re

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
    raise RefusedError("start another worker here", ("--task", f"see `--trust {count} --to data` and {count}:{LIMIT}"))
    return "SELECT what is there FROM all of them"
'''
KEPT = (
    "--population", "{count}", "{LIMIT}", "--{name}", "`dreamfleet runs`", "%d", "'too large'", "('--task'",
    "`--trust {count} --to data`", "{count}:{LIMIT}",
)  # fmt: skip


@pytest.mark.wording
def test_each_message_is_in_the_catalogue():
    assert catalogue() == GOLDEN.read_text(), "the wording changed: `make messages`, and read the difference"


def test_a_key_keeps_flags_numbers_values_and_names():
    code = ast.unparse(keyed(ast.parse(SAMPLE), "sample"))
    assert "A docstring is no message." in code
    assert "no more than that here" in code
    assert "FROM all of them" in code
    assert not [word for word in ("candidates", "start", "see ") if word in code]
    for kept in KEPT:
        assert kept in code


UNSAFE = re.compile(
    r"""
    ^\ *(?:import|from)\ +(?:pickle|cPickle|_pickle|dill|cloudpickle|shelve|marshal|joblib)\b
    | \b(?:yaml\.(?:full_|unsafe_)?load|torch\.jit\.load|pandas\.read_pickle)\(
    | \btorch\.load\((?!.*weights_only=True)
    | \ballow_pickle=(?!False)
    """,
    re.MULTILINE | re.VERBOSE,
)  # what could execute its input


def test_no_module_runs_what_it_reads():
    folders = ("common", "coordinator", "worker", "deploy", "dreamfleet")
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    found = {path.relative_to(ROOT).as_posix(): UNSAFE.findall(path.read_text()) for path in paths}
    assert len(found) > 300
    assert {path: what for path, what in found.items() if what} == {}


def test_each_kind_is_found_and_what_is_safe_is_not():
    unsafe = (
        "import pickle", "from cloudpickle import loads", "def f():\n    import marshal", "import shelve as s",
        "torch.load(path)", "torch.load(path, weights_only=False)", "np.load(path, allow_pickle=True)",
        "numpy.load(path, allow_pickle=anything)", "yaml.load(text, Loader)",
    )  # fmt: skip
    assert [len(UNSAFE.findall(each)) for each in unsafe] == [1] * len(unsafe)
    assert not UNSAFE.findall("np.load(path); torch.load(p, weights_only=True); json.loads(t)")
