"""Optimisers by name: what they need and keep. Tests registry.py, pycma.py, pycma_state.py and api.py."""

import subprocess
import sys
from importlib.metadata import entry_points

import numpy as np
import pytest

from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.coordinator.optimisers import registry
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.coordinator.optimisers.evolution import Evolution, parse_options
from dreamfleet.coordinator.optimisers.registry import build_optimiser, check_memory

MODULE = "tests.support.optimisers"


def build(optimiser, *options, covariance="diagonal", dimension=12, population=8):
    own = [] if covariance == "diagonal" else [f"covariance={covariance}"]
    return Evolution(optimiser, Search(np.zeros(dimension), population, 0.1, 3, parse_options([*options, *own])))


def test_without_docstrings_pycma_is_refused_as_a_wrong_command():
    words = [sys.executable, "-OO", "-m", "dreamfleet", "coordinator", "--run", "x", "--task", "gym:CartPole-v1"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, "-OO" in done.stderr.splitlines()[-1]) == (2, True)
    assert "Traceback" not in done.stderr


def test_an_optimiser_of_ones_own_is_found_by_entry_point(tmp_path):
    """As an installed package offers it: a folder of metadata on the path."""
    info = tmp_path / "others-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: others\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{registry.GROUP}]\nothers = {MODULE}:ParentsAndChildren\n")
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "import numpy as np; from dreamfleet.coordinator.optimisers.api import Search\n"
        "from dreamfleet.coordinator.optimisers.evolution import Evolution\n"
        "evolution = Evolution('others', Search(np.zeros(2), 4, 0.1, 3))\n"
        "print(evolution.state().head.requirement)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "parents-and-children==1.0"


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("cmea", "cma.* cma, cma-me, cmaes-lra"),
        ("openai-es", "openes.* cma"),
        ("OpenES", "openes.* cma"),
        ("cmaes", "cma.* cma, "),
        ("PGPE", "pepg.* cma"),
        ("adam", r"'adam'\S* [^,]*cma, "),
        ("nowhere:Optimiser", "--trust.* nowhere"),
        ("tests.support.nowhere:Optimiser", "tests.support.nowhere:Optimiser"),
        (f"{MODULE}:Nothing", f"{MODULE}:Nothing"),
        (f"{MODULE}:SaysNothing", "requirement, options"),
        (f"{MODULE}:WithoutState", r"\bstate\b"),
        (f"{MODULE}:BuiltFromNothing", f"{MODULE}:BuiltFromNothing"),
    ],
)
def test_an_unknown_or_incomplete_optimiser_is_refused_with_what_is_missing(name, says):
    with pytest.raises(UsageError, match=says):
        build(name)


@pytest.mark.add_on
@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        ({"covariance": "full"}, "'covariance'.*--covariance"),
        ({"options": ["elite=3"]}, "'elite'"),
        ({"options": ["elite"]}, "--optimiser-options.* 'elite'"),
        ({"options": ["a=1", "a=2"]}, "--optimiser-options.* 'a=2'"),
    ],
)
def test_an_option_that_an_optimiser_does_not_know_is_refused_with_what_it_knows(arguments, names):
    with pytest.raises(UsageError, match=names):
        build("cmaes-sep", *arguments.get("options", ()), covariance=arguments.get("covariance", "diagonal"))


def test_pycmas_covariance_is_an_option_and_a_setting():
    as_option, as_setting = build("cma", "covariance=full"), build("cma", covariance="full")
    assert np.array_equal(as_option.ask(), as_setting.ask())
    with pytest.raises(UsageError, match=r"diagonal, full.* 'half'"):
        build("cma", "covariance=half")
    with pytest.raises(UsageError, match="--optimiser-options"):
        build("cma", "covariance=full", covariance="full")


def test_an_option_reaches_an_optimiser_of_ones_own():
    elitist, broad = (build(f"{MODULE}:ParentsAndChildren", f"parents={count}") for count in (1, 8))
    asked = elitist.ask()
    assert np.array_equal(asked, broad.ask())
    for evolution in (elitist, broad):
        evolution.tell(np.arange(8.0))
    assert np.array_equal(elitist.mean, asked[-1])
    assert np.allclose(broad.mean, asked.mean(axis=0))


@pytest.mark.parametrize(
    ("name", "names"), [("AsksForTooMany", r"\(9, 12\) .*\(8, 12\)"), ("Diverged", "--from.*--sigma0")]
)
def test_a_population_that_is_none_is_refused(name, names):
    with pytest.raises(DreamfleetError, match=names):
        build(f"{MODULE}:{name}").ask()


def test_a_state_that_only_a_pickle_could_hold_is_refused():
    with pytest.raises(DreamfleetError, match=r"\bmean\b"):
        build(f"{MODULE}:KeepsObjects").state()


@pytest.mark.parametrize(
    ("optimiser", "dimension", "population", "flag"),
    [("cma", 300, 2, "--population"), ("cmaes-lra", 12, 3, "--population"), ("cmaes-sep", 1, 8, "--optimiser")],
)
def test_a_search_that_an_optimiser_cannot_do_is_refused_and_the_next_one_works(optimiser, dimension, population, flag):
    with pytest.raises(UsageError, match=flag):
        build(optimiser, dimension=dimension, population=population)
    more = {"dimension": 2} if dimension == 1 else {"dimension": dimension, "population": population + 1}
    evolution = build(optimiser, **more)
    for _ in range(12):
        asked = evolution.ask()
        evolution.tell(-((asked - 1) ** 2).sum(axis=1))


def test_two_candidates_are_enough_for_pycma_below_its_two_point_step_size():
    evolution = build("cma", dimension=299, population=2)
    for _ in range(12):
        evolution.tell(evolution.ask()[:, 0])
    assert evolution.mean[0] > 0


def test_starting_the_command_line_imports_no_optimiser():
    code = (
        "import sys; from dreamfleet.common.cli.command_line import main\n"
        "try: main(['coordinator', '--help'])\n"
        "except SystemExit: print({'cma', 'cmaes'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith("set()")
    assert entry_points(group=registry.GROUP)


@pytest.mark.add_on
def test_a_state_that_the_journal_cannot_keep_is_refused(monkeypatch):
    monkeypatch.setattr("dreamfleet.coordinator.optimisers.registry.usable_memory", lambda: 10**18)
    check_memory("cma", 5_000, 32, {"covariance": "full"})
    with pytest.raises(UsageError, match=r"\b1\.2 .*--cov"):
        check_memory("cma", 6_000, 32, {"covariance": "full"})
    with pytest.raises(UsageError, match=r"cmaes-lra.* 1\.6 "):
        check_memory("cmaes-lra", 10_000, 32, {})
    check_memory("cmaes-sep", 10**6, 32, {})


@pytest.mark.parametrize(("name", "options"), [("cma", {"covariance": "full"}), ("cmaes-lra", {})])
def test_the_counted_state_is_what_is_kept(name, options):
    optimiser = build_optimiser(name, Search(np.zeros(300), 8, 0.1, 1, options))
    for _ in range(3):
        optimiser.tell(-np.square(optimiser.ask() - 1).sum(axis=1))
    counted = type(optimiser).footprint(300, 8, options).state
    assert sum(each.nbytes for each in optimiser.state().values()) == pytest.approx(counted, rel=0.1)
