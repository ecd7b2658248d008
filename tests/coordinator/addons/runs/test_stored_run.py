"""A run in a user's program: tables as data frames, the picture of `runs plot`, its controller and world model."""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

from dreamfleet.common.cli import command_line
from dreamfleet.common.errors import BundleError, ControllerError, JournalError, UsageError
from dreamfleet.coordinator.addons.runs.export import ELITES, TABLES
from dreamfleet.coordinator.addons.runs.plot import KINDS, fitness_figure, save_figure
from dreamfleet.coordinator.addons.runs.stored_run import TableName, open_run
from tests.support.processes import DEADLINE, environment

RUNS = Path(__file__).parents[3] / "fixtures" / "runs"


@pytest.fixture
def reality():
    with open_run("reality", RUNS) as run:
        yield run


@pytest.mark.parametrize("package", ["pandas", "polars"])
def test_tables_are_data_frames(reality, package):
    pytest.importorskip(package)

    def frame(*table):
        return getattr(reality, f"to_{package}")(*table)

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
    [("to_pandas()", "pandas", "pip install pandas"), ("to_polars()", "polars", "pip install polars"),
     ("plot()", "matplotlib", "pip install 'dreamfleet[views]'")],
)  # fmt: skip
def test_without_the_package_the_error_names_what_to_install(tmp_path, call, package, remedy):
    program = (
        f"import sys, dreamfleet; sys.modules[{package!r}] = None\ndreamfleet.open_run('reality', {str(RUNS)!r}).{call}"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment(tmp_path), capture_output=True, text=True, check=False,
        timeout=DEADLINE,
    )  # fmt: skip
    assert re.search(rf"MissingExtraError: .*{package!r}.*{re.escape(remedy)}", done.stderr)


def test_it_plots_what_the_verb_plots(reality, tmp_path):
    for words, kind in (((), "fitness"), (("--kind", "learning"), "learning")):
        out = tmp_path / "verb.png"
        assert command_line.main(["runs", "plot", "reality", *words, "--runs-dir", str(RUNS), "--out", str(out)]) == 0
        reality.plot(kind).savefig(tmp_path / "own.png", dpi=120)
        assert out.read_bytes() == (tmp_path / "own.png").read_bytes(), kind


def test_a_run_without_evaluations_has_its_fitness_plotted(tmp_path):
    with open_run("hidden", RUNS) as run:
        figure = run.plot()
        assert figure.axes[0].get_ylabel()
        with pytest.raises(UsageError, match="--evaluate-every"):
            run.plot("learning")
        with pytest.raises(UsageError, match=r"archive.*'curve'"):
            run.plot("curve")
        save_figure(fitness_figure(run), tmp_path / f"own{KINDS[1]}")


SHOWN = """
import base64, dreamfleet, sys
from IPython.core.formatters import DisplayFormatter
shown, _ = DisplayFormatter().format(dreamfleet.open_run('reality', {runs!r}).plot({kind!r}))
assert shown['image/png'].startswith(b'\\x89PNG'), shown.keys()
assert 'matplotlib.pyplot' not in sys.modules
"""


@pytest.mark.parametrize("kind", ["fitness", "learning"])
def test_a_fresh_notebook_shows_a_plot(kind, tmp_path):
    pytest.importorskip("IPython")
    program = SHOWN.format(runs=str(RUNS), kind=kind)
    subprocess.run([sys.executable, "-c", program], env=environment(tmp_path), check=True, timeout=DEADLINE)


def test_the_names_of_tables_are_known_to_type_checkers():
    assert get_args(TableName) == (*TABLES, ELITES)


def test_its_controller_and_world_model_are_those_of_its_folder(reality, tmp_path):
    assert reality.controller().bundle == reality.spec.bundle
    with pytest.raises(BundleError, match="bundle"):  # a run of the tests is stored without it
        reality.bundle()
    shutil.copytree(RUNS / "reality", tmp_path / "reality", ignore=shutil.ignore_patterns("controller.npz"))
    with open_run("reality", tmp_path) as run, pytest.raises(ControllerError, match=r"reality\b.*controller\.npz"):
        run.controller()


def test_an_unknown_run_names_those_that_there_are():
    with pytest.raises(JournalError, match="reality"):
        open_run("realty", RUNS)
