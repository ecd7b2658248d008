"""The examples in docstrings run as they stand, and every public name has one."""

import doctest
import re
from importlib import import_module

import pytest

import dreamfleet
from deploy.structure import ROOT, SIDES, module_of, sources
from dreamfleet.coordinator.optimisers import api as optimisers_api
from dreamfleet.worker.addons.baselines.export import export_network
from dreamfleet.worker.addons.baselines.network import Networks
from dreamfleet.worker.addons.baselines.presets import AgentConfig
from dreamfleet.worker.tasks import api as tasks_api
from dreamfleet.worker.worlds.trained_agent import AgentManifest, TrainedAgent
from tests.support.processes import processes_in

RUN = "cartpole"  # the live run of the examples
PUBLIC = [getattr(dreamfleet, name) for name in dreamfleet.__all__]
CONTRACTS = [
    each
    for api in (optimisers_api, tasks_api)
    for each in vars(api).values()
    if isinstance(each, type) and each.__module__ == api.__name__
]


def name_of(found):
    return f"{found.__module__}.{found.__qualname__}"


def find_examples():
    """The doctests of all modules by name. Those of public names import all that they use."""
    paths = [path for path in sources(*SIDES) if ">>>" in (ROOT / path).read_text()]
    names = [f"dreamfleet.{module_of(path)}".removesuffix(".__init__") for path in paths]
    tests = [
        test
        for module in (dreamfleet, *map(import_module, names))
        for test in doctest.DocTestFinder(exclude_empty=True).find(module)
        if test.examples
    ]
    for test in tests:
        if test.name in map(name_of, PUBLIC):
            test.globs = {"__name__": "__main__"}
    return {test.name: test for test in tests}


EXAMPLES = find_examples()


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """A coordinator that evolves a run for as long as the tests last, and its worker `alpha`."""
    with processes_in(tmp_path_factory.mktemp("fleet")) as processes:
        coordinator = processes.coordinator(
            "--task", "gym:CartPole-v1", "--population", 4, "--episodes", 2, "--evaluate-every", 1,
            "--evaluation-episodes", 2, name=RUN,
        )  # fmt: skip
        processes.worker("--run", RUN, "--name", "alpha")
        coordinator.wait_for_event("evaluation")
        yield processes


@pytest.fixture(scope="module")
def agent():
    config = AgentConfig(channels=(4, 4), kernels=(8, 4), strides=(4, 2), hidden=8, frame_skip=3)
    weights = {name: tensor.numpy() for name, tensor in Networks(config).online.state_dict().items()}
    manifest = AgentManifest("drqn", "car-racing", "box-64", config.table, config.frame_skip, 2 * config.hidden)
    return TrainedAgent(manifest, export_network(weights, config))


@pytest.fixture
def folder(agent, tmp_path, monkeypatch):
    """The folder that the examples run in, with an exported agent."""
    agent.save(tmp_path / "drqn.zip")
    monkeypatch.chdir(tmp_path)


STARTS_A_RUN = re.compile(r"\b(start_run|evolve|minimise|maximise)\(")


@pytest.mark.wording
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if STARTS_A_RUN.search(test.docstring) else ())
        for name, test in EXAMPLES.items()
    ],
)
def test_an_example_runs(name, folder, request, monkeypatch):
    test = EXAMPLES[name]
    if RUN in test.docstring:
        fleet = request.getfixturevalue("fleet")
        monkeypatch.setenv("DREAMFLEET_RUNS_DIR", str(fleet.runs))
        test.globs["address"] = fleet.endpoint
    report = []
    assert not doctest.DocTestRunner().run(test, out=report.append, clear_globs=False).failed, "".join(report)


@pytest.mark.parametrize("found", [*PUBLIC, *CONTRACTS], ids=name_of)
def test_a_public_name_has_an_example(found):
    examples = EXAMPLES[name_of(found)].examples
    assert not [each for each in examples if each.options.get(doctest.SKIP)]
