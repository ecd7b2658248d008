import subprocess
import sys
from importlib.metadata import entry_points

import numpy as np
import pytest

from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.coordinator.optimisers import registry
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.coordinator.optimisers.evolution import Evolution, EvolutionConfig
from dreamfleet.coordinator.optimisers.registry import build_optimiser, check_memory

MODULE = "tests.support.optimisers"


def build(optimiser, *options, covariance="diagonal", dimension=12, population=8):
    return Evolution(EvolutionConfig(dimension, population, 0.1, covariance, 3, optimiser, options))


def test_what_ships_is_registered():
    assert set(registry.known_optimisers()) >= {"cma", "cmaes-lra", "cmaes-sep", "openes", "pepg", "snes", "xnes"}


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
        "from dreamfleet.coordinator.optimisers.evolution import Evolution, EvolutionConfig\n"
        "evolution = Evolution(EvolutionConfig(2, 4, 0.1, 'diagonal', 3, 'others'))\n"
        "print(evolution.state().head.requirement)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "parents-and-children==1.0"


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("cmea", "did you mean cma.* known are cma, cma-me, cmaes-lra"),
        ("openai-es", "did you mean openes"),
        ("OpenES", "did you mean openes"),
        ("cmaes", "did you mean cma"),
        ("PGPE", "did you mean pepg"),
        ("adam", "'adam': known are cma"),
        ("nowhere:Optimiser", "--trust nowhere"),
        ("tests.support.nowhere:Optimiser", "cannot be loaded"),
        (f"{MODULE}:Nothing", "cannot be loaded"),
        (f"{MODULE}:SaysNothing", "lacks requirement, options"),
        (f"{MODULE}:WithoutState", r"lacks state: dreamfleet\.coordinator\.optimisers\.api"),
        (f"{MODULE}:BuiltFromNothing", "must be built from one Search"),
    ],
)
def test_an_unknown_or_incomplete_optimiser_is_refused_with_what_is_missing(name, says):
    with pytest.raises(UsageError, match=says):
        build(name)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"covariance": "full"}, "has no option 'covariance', it knows: none; give --covariance diagonal"),
        ({"options": ["elite=3"]}, "has no option 'elite', it knows: none"),
        ({"options": ["elite"]}, "takes name=value"),
        ({"options": ["a=1", "a=2"]}, "each name once"),
    ],
)
def test_an_option_that_an_optimiser_does_not_know_is_refused_with_what_it_knows(arguments, says):
    with pytest.raises(UsageError, match=says):
        build("cmaes-sep", *arguments.get("options", ()), covariance=arguments.get("covariance", "diagonal"))


def test_pycmas_covariance_is_an_option_and_a_setting():
    as_option, as_setting = build("cma", "covariance=full"), build("cma", covariance="full")
    assert np.array_equal(as_option.ask(), as_setting.ask())
    with pytest.raises(UsageError, match="diagonal, full, not 'half'"):
        build("cma", "covariance=half")
    with pytest.raises(UsageError, match="each name once"):
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
    ("name", "says"),
    [("AsksForTooMany", r"asked for \(9, 12\) numbers, not \(8, 12\)"), ("Diverged", "no single-precision number")],
)
def test_a_population_that_is_none_is_refused(name, says):
    with pytest.raises(DreamfleetError, match=says):
        build(f"{MODULE}:{name}").ask()


def test_a_state_that_only_a_pickle_could_hold_is_refused():
    with pytest.raises(DreamfleetError, match="cannot be kept, in mean"):
        build(f"{MODULE}:KeepsObjects").state()


@pytest.mark.parametrize(
    ("optimiser", "dimension", "population", "says"),
    [
        ("cma", 300, 2, "at least 3 for 300 parameters, not 2: give --population"),
        ("cmaes-lra", 12, 3, "at least 4, not 3: give --population"),
        ("cmaes-sep", 1, 8, "at least 2 parameters"),
    ],
)
def test_a_search_that_an_optimiser_cannot_do_is_refused_and_the_next_one_works(optimiser, dimension, population, says):
    with pytest.raises(UsageError, match=says):
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


def test_a_state_that_the_journal_cannot_keep_is_refused(monkeypatch):
    monkeypatch.setattr("dreamfleet.coordinator.optimisers.registry.usable_memory", lambda: 10**18)
    check_memory("cma", 5_000, 32, {"covariance": "full"})
    with pytest.raises(UsageError, match=r"has a state of 1\.2 GB, a journal keeps 1 GB at most: give --cov"):
        check_memory("cma", 6_000, 32, {"covariance": "full"})
    with pytest.raises(UsageError, match=r"cmaes-lra .* has a state of 1\.6 GB"):
        check_memory("cmaes-lra", 10_000, 32, {})
    check_memory("cmaes-sep", 10**6, 32, {})


@pytest.mark.parametrize(("name", "options"), [("cma", {"covariance": "full"}), ("cmaes-lra", {})])
def test_the_counted_state_is_what_is_kept(name, options):
    optimiser = build_optimiser(name, Search(np.zeros(300), 8, 0.1, 1, options))
    for _ in range(3):
        optimiser.tell(-np.square(optimiser.ask() - 1).sum(axis=1))
    counted = type(optimiser).footprint(300, 8, options).state
    assert sum(each.nbytes for each in optimiser.state().values()) == pytest.approx(counted, rel=0.1)
