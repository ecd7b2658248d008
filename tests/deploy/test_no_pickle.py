"""No module uses a loader that could execute the files of another party.

`multiprocessing` pickles what passes between a process and the children that it started itself; nobody else reaches
those pipes. A task's or an optimiser's module is code that was installed here, or named on this host's command line.
"""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("common", "coordinator", "worker", "deploy", "dreamfleet")
MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "shelve", "marshal", "joblib"}
CALLS = {"eval", "exec", "yaml.load", "yaml.full_load", "yaml.unsafe_load", "torch.jit.load", "pandas.read_pickle"}
SAFE = {"torch.load": ("weights_only", True), "numpy.load": ("allow_pickle", False), "np.load": ("allow_pickle", False)}
DEFAULTS = {"numpy.load", "np.load"}  # safe by default


def unsafe(source):
    """Calls in a source that could execute their input: (line, name)."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else [each.name for each in node.names]
            yield from ((node.lineno, name) for name in modules if name.split(".")[0] in MODULES)
        elif isinstance(node, ast.Call) and not _is_safe(node):
            yield node.lineno, ast.unparse(node.func)


def _is_safe(call):
    name = ast.unparse(call.func)
    keyword, wanted = SAFE.get(name, ("", None))
    said = [ast.unparse(each.value) for each in call.keywords if each.arg == keyword]
    if name in SAFE:
        return said == [str(wanted)] or (not said and name in DEFAULTS)
    return name not in CALLS


def test_no_module_runs_what_it_reads():
    paths = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py") if not path.is_symlink()]
    found = {path.relative_to(ROOT).as_posix(): list(unsafe(path.read_text())) for path in paths}
    assert len(found) > 300
    assert {path: what for path, what in found.items() if what} == {}


@pytest.mark.parametrize(
    "source",
    [
        "import pickle", "from cloudpickle import loads", "def f():\n    import marshal", "import shelve as s",
        "torch.load(path)", "torch.load(path, weights_only=False)", "np.load(path, allow_pickle=True)",
        "numpy.load(path, allow_pickle=anything)", "yaml.load(text, Loader)", "eval(text)", "exec(text)",
    ],
)  # fmt: skip
def test_each_kind_is_found_and_what_is_safe_is_not(source):
    assert len(list(unsafe(source))) == 1
    assert not list(unsafe("np.load(path); torch.load(p, weights_only=True); model.eval(); json.loads(t)"))
