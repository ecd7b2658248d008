"""A run in a user's program: tables as data frames, the picture of `runs plot`, its controller and world model."""

import subprocess
import sys
from typing import get_args

import pytest

from dreamfleet.common.errors import BundleError, ControllerError, MissingExtraError, UsageError
from dreamfleet.coordinator.addons.runs.export import ELITES, TABLES
from dreamfleet.coordinator.addons.runs.plot import KINDS, fitness_figure, save_figure
from dreamfleet.coordinator.addons.runs.stored_run import TableName, open_run
from tests.support.processes import DEADLINE, environment, printed


@pytest.fixture
def reality(runs):
    with open_run("reality") as run:
        yield run


@pytest.mark.parametrize("package", ["pandas", "polars"])
def test_tables_are_data_frames(reality, package):
    pytest.importorskip(package)
    frame = getattr(reality, f"to_{package}")
    history, scores = reality.history(), reality.evaluations()
    assert list(frame()["mean"]) == [each.mean for each in history]
    assert list(frame("evaluations")["error"]) == [each.error for each in scores]
    assert len(frame("candidates")) == len(reality.candidates())
    assert list(frame("candidates").columns)[:3] == ["generation", "number", "fitness"]
    assert len(frame("confirmation")) == 0  # its columns are there
    assert "mean" in frame("confirmation").columns


def test_a_wrong_table_names_those_that_there_are(reality):
    with pytest.raises(UsageError, match="generations, candidates, evaluations, confirmation"):
        reality.to_pandas("candidate")
    with pytest.raises(UsageError, match="--archive"):
        reality.to_pandas("elites")


@pytest.mark.parametrize(
    ("call", "package", "remedy"),
    [("to_pandas", "pandas", "pip install pandas"), ("to_polars", "polars", "pip install polars"),
     ("plot", "matplotlib", r"pip install 'dreamfleet\[views\]'")],
)  # fmt: skip
def test_without_the_package_the_error_names_what_to_install(reality, monkeypatch, call, package, remedy):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=f"{package!r}.*{remedy}"):
        getattr(reality, call)()


@pytest.mark.parametrize("kind", ["fitness", "learning"])
def test_it_plots_what_the_verb_plots(reality, tmp_path, kind):
    printed("runs", "plot", "reality", "--kind", kind, "--out", tmp_path / "verb.png")
    reality.plot(kind).savefig(tmp_path / "own.png", dpi=120)
    assert (tmp_path / "verb.png").read_bytes() == (tmp_path / "own.png").read_bytes()


def test_a_run_without_evaluations_has_its_fitness_plotted(runs, tmp_path):
    with open_run("hidden") as run:
        assert run.plot().axes[0].get_ylabel()
        with pytest.raises(UsageError, match="--evaluate-every"):
            run.plot("learning")
        with pytest.raises(UsageError, match=r"archive.*'curve'"):
            run.plot("curve")
        save_figure(fitness_figure(run), tmp_path / f"own{KINDS[1]}")


SHOWN = """
import dreamfleet, sys
from IPython.core.formatters import DisplayFormatter
run = dreamfleet.open_run('reality')
for kind in ('fitness', 'learning'):
    shown, _ = DisplayFormatter().format(run.plot(kind))
    assert shown['image/png'].startswith(b'\\x89PNG'), (kind, shown.keys())
assert 'matplotlib.pyplot' not in sys.modules
"""


def test_a_fresh_notebook_shows_plots(runs, tmp_path):
    pytest.importorskip("IPython")
    subprocess.run([sys.executable, "-c", SHOWN], env=environment(tmp_path), check=True, timeout=DEADLINE)


def test_the_names_of_tables_are_known_to_type_checkers():
    assert get_args(TableName) == (*TABLES, ELITES)


def test_its_controller_and_world_model_are_those_of_its_folder(reality):
    assert reality.controller().bundle == reality.bundle().sha256
    reality.bundle_path.unlink()
    with pytest.raises(BundleError, match="bundle"):
        reality.bundle()
    reality.controller_path.unlink()
    with pytest.raises(ControllerError, match="reality"):
        reality.controller()
