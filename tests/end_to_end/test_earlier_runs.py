"""Runs that the version before this layout recorded: they open, replay and go on, to the bit on an equal host.

`tests/fixtures` holds their journals, the controllers that they reported, their world model, and what the version that
wrote them gave when it continued them. CarRacing computes what it did when it was the only world:
`tests/support/first_world.py` says what is compared, and writes the fixture.

Tests common/runs/journal/schema.py, common/runs/records.py, coordinator/optimisers/checkpoint.py,
coordinator/optimisers/pycma_state.py, coordinator/storage/journal.py, worker/scoring/scorer.py and
worker/worlds/car_racing/environment.py, worker/worldmodel/export.py.
"""

import json
from pathlib import Path

import pytest

from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.runs.run_folder import open_run
from tests.support.first_world import GOLD, HOST, PARTS

FIXTURES = Path(__file__).parents[1] / "fixtures"
CONTINUED = json.loads((FIXTURES / "continued.json").read_text())
NAMES = sorted(CONTINUED)


@pytest.mark.parametrize("name", NAMES)
def test_their_candidates_are_scored_as_they_were(processes, runs, name):
    with open_run(runs, name) as run:
        here = run.fingerprint == fingerprint()
    code, out, err = processes.call("verify", "candidate", name, "--runs-dir", runs, "--candidate", "1/2")
    assert code in (0, 1), err
    assert not here or (code == 0 and "DIFFERS" not in out)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_they_go_on_as_the_version_that_wrote_them_would(processes, runs, name):
    expected = CONTINUED[name]
    with open_run(runs, name) as run:
        loosened = () if run.fingerprint == fingerprint() else ("--no-strict",)  # it was strict, and is so still
    coordinator = processes.start(
        "coordinator", "--resume", name, "--runs-dir", runs, "--listen", processes.endpoint,
        "--generations", expected["generations"], *loosened,
    )  # fmt: skip
    processes.worker("--run", name, "--exit-when-done")
    code, _ = coordinator.finish()
    assert code == 0, "".join(coordinator.lines)
    with open_run(runs, name) as run:
        assert len(run.history()) == expected["generations"]
        fitness = [[run.fitness(g, i) for i in range(len(row))] for g, row in enumerate(expected["fitness"])]
        evaluations = [[each.generation, each.mean.hex()] for each in run.evaluations()]
    if not loosened:
        assert [[each.hex() for each in row] for row in fitness] == expected["fitness"]
        assert evaluations == expected["evaluations"]


# SWIG warns as Box2D is imported, and an error there kills the process.
pytestmark = pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")


@pytest.mark.parametrize("part", PARTS)
def test_the_first_world_computes_what_it_did(part, tmp_path):
    gold = json.loads(GOLD.read_text())[part]
    found = json.loads(json.dumps(PARTS[part](tmp_path)))
    assert found.keys() == gold.keys()
    for kind, recorded in gold.items():
        if recorded["host"] == HOST[kind]:
            assert found[kind] == recorded["found"], kind
