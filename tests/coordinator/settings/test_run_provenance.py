"""The receipt in a reported controller: drawn up from the journal, and enough to begin the run again; a subspace;
worlds that a bundle describes, of which this host has nothing.
Tests dreamfleet/experiments/rerun.py and common/addons/worlds/takecover.py."""

import json
import re
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import one_hot
from dreamfleet.common.artifacts.bundle_store import shipped_names
from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.artifacts.subspace import SearchSpace, Subspace
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts, WorldFacts
from dreamfleet.common.errors import ControllerError, JournalError, UsageError
from dreamfleet.common.protocol.messages import OWN_END_VERSION
from dreamfleet.common.runs.effort import START_EFFORT, Effort
from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
from dreamfleet.common.runs.records import RunSettings, StageSettings
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.common.runs.run_provenance import RunProvenance, read_run_provenance, read_run_settings
from dreamfleet.common.runs.stages import stages_of
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.common.worlds import shipped
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.coordinator.optimisers.evolution import Evolution
from dreamfleet.coordinator.service.main import RunRequest, _resolve_settings
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.settings.presets import find_preset
from dreamfleet.coordinator.settings.resume_settings import serving_facts
from dreamfleet.coordinator.settings.start import StartPoint, find_start, stored_subspace
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.experiments.demo import DemoConfig
from dreamfleet.experiments.rerun import Rerun
from tests.support.bundles import write_world_bundle
from tests.support.dispatched import result
from tests.support.dreams import ABOUT, DRAWN, MODELS, VAE, WORLDS, write_bundle_of
from tests.support.frozen_settings import comes_back
from tests.support.run_bench import EVALUATED, Reporting


class Spending(Reporting):
    """Each result took a tenth of a second and ten steps."""

    start = None

    def begin(self):
        if self.start is not None:
            for name, text in {**self.start.facts, **serving_facts(self.limits, NetworkConfig())}.items():
                self.journal.set_fact(name, text)
            self.journal.commit()
        super().begin()

    def end(self):
        super().end()
        return Controller.load(self.path / CONTROLLER)


@pytest.fixture
def make(make_bench):
    return lambda start=None, **changes: make_bench(
        type("One", (Spending,), {"start": start}), replace(EVALUATED, **changes), 4
    )


def test_it_holds_generations_effort_fingerprint_versions_and_seeds(make):
    bench = make()
    receipt = read_run_provenance(bench.end())
    settings = bench.settings
    scored = 4 * settings.population * settings.episodes
    assert receipt.generations == 4
    assert receipt.effort == Effort(10 * scored, 10 * 2 * 2, 0, 100_000 * (scored + 4))
    assert (receipt.fingerprint, receipt.mixed, receipt.start) == ("f", False, None)
    assert {"dreamfleet", "numpy", "cma", "python"} <= receipt.versions.keys()
    assert receipt.seeds == {"evaluation": (20_000, 2)}
    assert read_run_settings(bench.saved()) == settings


def test_effort_is_counted_on_once_a_result_as_it_would_be_summed_up(make):
    bench = make()
    before = bench.journal.results.effort
    (_, job), *_ = bench.fetch()
    bench.step()
    bench.answer(result(job.digest))
    assert bench.journal.results.effort == before + Effort(10, 0, 0, 100_000)
    again = Journal(bench.path / "journal.sqlite")
    assert again.results.effort == bench.journal.results.effort
    again.close()


def test_a_start_is_in_it_whole_with_what_had_been_spent(make, tmp_path):
    size = EVALUATED.controller.size
    start = StartPoint(np.linspace(0, 1, size), EVALUATED.task.bundle, "controller a", "", Effort(5, 6, 7, 8))
    bench = make(start)
    found = read_run_provenance(bench.end())
    assert np.array_equal(found.start.vector, start.mean)
    assert (found.start.source, found.start.effort, found.mixed) == ("controller a", start.effort, False)
    assert found.total == start.effort + found.effort
    follower = find_start(str(bench.path / CONTROLLER), tmp_path)
    assert follower.effort == found.total
    assert json.loads(follower.facts[START_EFFORT])["driven"] == found.total.driven


def test_a_start_of_unknown_origin_has_no_effort(tmp_path, random_bundle):
    shape = random_bundle.controller_shape
    Controller(shape, np.zeros(shape.size, np.float32), "dream", random_bundle.sha256).save(tmp_path / "a.npz")
    start = find_start(str(tmp_path / "a.npz"), tmp_path)
    assert start.effort is None
    assert START_EFFORT not in start.facts


def test_what_ships_can_be_begun_again_as_it_was(tmp_path):
    controller, _ = find_controller("tiny", tmp_path)
    bundle = find_bundle_of(controller, None)
    again = Rerun.of(controller, bundle)
    config, kept = again.plan(tmp_path / "tiny-again")
    assert freeze(config, bundle) == read_run_settings(controller)
    assert (again.limits, again.start) == (LimitsConfig(generations=25), None)
    assert kept == {"failure_limit": 1.0}, "the first run went on, whatever failed"
    assert again.expected_difference  # it is from before receipts


def test_another_run_is_not_gone_on_with_and_another_version_is_named(tmp_path, random_bundle):
    controller, settings = begun(random_bundle, population=6), freeze(RunConfig(population=5), random_bundle)
    folder = tmp_path / "other"
    folder.mkdir()
    Journal.create(folder, settings, random_bundle.path).close()
    again = Rerun.of(controller, random_bundle)
    with pytest.raises(UsageError, match=r"other .*--run"):
        again.plan(folder)
    strange = replace(again, settings=replace(again.settings, packages=("rocks",)))
    with pytest.raises(UsageError, match="packages"):
        strange.plan(tmp_path / "new")


def begun(bundle, **changes):
    """A controller of a run that has just begun."""
    settings = freeze(RunConfig(**changes), bundle)
    provenance = {"settings": asdict(settings), "generation": 0, "steps": 10}
    still = np.zeros(settings.controller.size, np.float32)
    return Controller(settings.controller, still, settings.task.task, bundle.sha256, provenance)


def test_a_run_that_closed_nothing_cannot_be_repeated(random_bundle):
    controller = begun(random_bundle)
    provenance = {**controller.provenance, "receipt": {"generations": 0, "effort": {}}}
    with pytest.raises(ControllerError):
        Rerun.of(replace(controller, provenance=provenance), random_bundle)


def test_no_file_chooses_what_is_imported(random_bundle, tmp_path):
    again = Rerun.of(begun(random_bundle), random_bundle)
    strange = replace(again, settings=replace(again.settings, optimiser="antigravity:fly"))
    with pytest.raises(UsageError, match=r"--trust.* antigravity"):
        strange.plan(tmp_path / "again")
    assert "antigravity" not in sys.modules


@pytest.mark.slow
def test_a_run_is_compared_with_another_that_began_alike_and_why_they_differ_is_said_as_far_as_it_is_known(make):
    first, second = make(), make(seed=2)
    again = Rerun.of(first.end(), None)
    second.end()
    elsewhere = StartPoint(np.ones(first.settings.controller.size), first.settings.task.bundle, "elsewhere")
    for other in (first, make(elsewhere)):
        with pytest.raises(UsageError, match=f"{other.path.name} .*--run"):
            again.plan(other.path)
    assert again.plan(make().path)[0] is None
    assert again.compare(first.path).same
    found = again.compare(second.path)
    assert not found.same
    reasons = {found.why}
    for changes in ({"mixed": True}, {"fingerprint": None}, {"fingerprint": "g"}, {"versions": {"cma": "1"}}):
        other = replace(again, receipt=replace(again.receipt, **changes))
        reasons.add(other.compare(second.path).why)
    assert len(reasons) == 5
    with pytest.raises(JournalError):
        again.compare(first.path.parent)


@pytest.mark.slow
def test_whether_hosts_of_the_second_time_are_of_the_first_ones_class_is_said(make):
    first, second = make(), make(seed=2)
    first.host_class, second.host_class = "a" * 16, "b" * 16
    controller = first.end()
    second.end()
    assert not read_run_provenance(controller).classes.mixed
    again = Rerun.of(controller, None)
    assert again.compare(first.path).same
    for each in ("a", "b"):
        assert each * 16 in again.compare(second.path).summary


SHAPE = ControllerShape(9, 2)
OPTIMISERS = [("cma", "diagonal"), ("cma", "full"), ("cmaes-sep", "diagonal"), ("cmaes-lra", "diagonal")]


def few(inputs=9, bundle="ab" * 32):
    random = np.random.default_rng(1)
    return Subspace(random.normal(size=(2, inputs)).astype(np.float32), np.zeros(2, np.float32), ("a", "b"), bundle)


def build(optimiser="cma", covariance="diagonal", start=None):
    options = {} if covariance == "diagonal" else {"covariance": covariance}
    search = Search(np.zeros(SHAPE.size) if start is None else start, 8, 0.3, 3, options)
    return Evolution(optimiser, search, SearchSpace(few(), SHAPE))


def run(evolution, generations):
    for generation in generations:
        noise = np.random.default_rng(generation).normal(size=8)
        evolution.tell(-((evolution.ask() - 1.0) ** 2).sum(axis=1) + 0.1 * noise)


@pytest.mark.parametrize(("optimiser", "covariance"), OPTIMISERS)
def test_it_keeps_to_the_subspace_and_continues_to_the_bit(optimiser, covariance):
    start = np.random.default_rng(2).normal(size=SHAPE.size)
    whole, first = (build(optimiser, covariance, start) for _ in range(2))
    run(whole, range(12))
    run(first, range(5))
    second = build(optimiser, covariance)  # a resumed run does not know where its search began
    second.restore(first.state().packed())
    run(second, range(5, 12))
    asked = whole.ask()
    assert np.array_equal(second.ask(), asked)
    assert np.array_equal(second.mean, whole.mean)
    assert np.linalg.matrix_rank(asked - start, tol=1e-9) <= SearchSpace(few(), SHAPE).dimension == 6


@pytest.mark.parametrize(
    "origin", [None, np.full(SHAPE.size, "a"), np.full(SHAPE.size, np.nan), np.full(SHAPE.size, 1e300), np.zeros(3)]
)
def test_a_missing_or_damaged_origin_is_the_journals_fault(origin):
    checkpoint = build().state()
    state = replace(checkpoint, head=replace(checkpoint.head, origin=origin)).packed()
    with pytest.raises(JournalError):
        build().restore(state)


@pytest.fixture
def settings(random_bundle):
    subspace = few(random_bundle.controller_shape.features, random_bundle.sha256)

    def made(**flags):
        return freeze(RunConfig(loaded_subspace=subspace, **flags), random_bundle), subspace

    return made


def test_it_is_frozen_by_its_hash_and_a_later_stage_leaves_it(settings):
    found, subspace = settings(stages=(StageSettings(generations=2), StageSettings(all_parameters=True, sigma0=0.01)))
    assert found.subspace == subspace.sha256
    assert RunSettings.from_json(found.to_json()) == found
    first, second = stages_of(found)
    assert (first.all_parameters, second.all_parameters, second.starts_new_search) == (False, True, True)
    searches = [Evolution.of(found, stage, subspace, None) for stage in (first, second)]
    assert [each.state().head.origin is None for each in searches] == [False, True]


@pytest.mark.parametrize(
    ("stages", "number"),
    [
        ((StageSettings(all_parameters=True),), 1),
        ((StageSettings(generations=2), StageSettings(all_parameters=True)), 2),
        (
            (StageSettings(generations=2), StageSettings(all_parameters=True, sigma0=0.1, generations=2),
             StageSettings(all_parameters=True, sigma0=0.1)), 3,
        ),
    ],
)  # fmt: skip
def test_a_schedule_leaves_it_once(settings, stages, number):
    with pytest.raises(UsageError, match=rf"\b{number}\b"):
        settings(stages=stages)


def test_nothing_to_leave_is_refused_and_a_subspace_of_another_world_model_or_of_other_eyes(
    random_bundle,
):
    stages = (StageSettings(generations=2), StageSettings(all_parameters=True, sigma0=0.1))
    with pytest.raises(UsageError, match=r"2.*--subspace"):
        freeze(RunConfig(stages=stages), random_bundle)
    features = random_bundle.controller_shape.features
    with pytest.raises(UsageError, match=r"--subspace .*abababababab"):
        freeze(RunConfig(loaded_subspace=few(features)), random_bundle)
    with pytest.raises(UsageError, match=f"--subspace .*{features - 1} .*{features}"):
        freeze(RunConfig(loaded_subspace=few(features - 1, random_bundle.sha256)), random_bundle)
    with pytest.raises(UsageError, match="--subspace"):
        freeze(RunConfig(task="gym:CartPole-v1", loaded_subspace=few(4)), None)


def test_what_a_journal_kept_of_it_is_held_to_the_settings(settings, tmp_path):
    found, subspace = settings()
    assert stored_subspace(subspace.text, found, tmp_path).sha256 == subspace.sha256
    assert stored_subspace(subspace.text, replace(found, subspace=""), tmp_path) is None
    for damaged in (None, "", "{}", few().text):
        with pytest.raises(JournalError, match=re.escape(str(tmp_path))):
            stored_subspace(damaged, found, tmp_path)


def test_a_receipt_of_another_subspace_than_its_settings_is_damaged(settings, random_bundle):
    (found, subspace), shape = settings(), random_bundle.controller_shape
    controller = Controller(shape, np.zeros(shape.size, np.float32), "car-racing", random_bundle.sha256)

    def planned(kept):
        receipt = RunProvenance(1, Effort(), subspace=kept)
        return Rerun(controller, random_bundle, found, receipt).plan(Path("nowhere") / "again")[0]

    for kept in (None, few().text, "{}"):
        with pytest.raises(ControllerError):
            planned(kept)
    assert planned(subspace.text).loaded_subspace.sha256 == subspace.sha256


ABSENT = "a.package.that.is.not.here:Task"


@pytest.fixture
def bundle(tmp_path):
    facts = replace(WORLDS["choices"], packages=("numpy", "onnxruntime", "absent-simulator"), version=3)
    return write_world_bundle(tmp_path / "b.zip", facts, ABSENT, vae=VAE, rnn=MODELS["choices"])


def settings_of(bundle, **flags):
    return freeze(RunConfig(bundle=str(bundle.path), **flags), bundle)


def test_a_run_begins_without_the_worlds_package_and_can_be_configured_again(bundle, tmp_path):
    config = RunConfig(bundle=str(bundle.path), task="dream", variant=("decide_every=4", "feedback=last"))
    request = RunRequest("run", tmp_path, config, LimitsConfig(), NetworkConfig())
    settings, found, *_ = _resolve_settings(request, tmp_path / "run")
    assert found.sha256 == bundle.sha256
    assert settings.packages == ("numpy", "onnxruntime", "absent-simulator")
    assert settings.task.version == 3
    assert settings.task.options == '{"decide_every": 4, "feedback": "last"}'
    assert settings.controller == ControllerShape(3 + 4 + 2 * 3, 3)
    assert comes_back(settings, bundle)


def test_without_a_task_it_is_the_bundles_own_world(bundle, random_bundle):
    assert settings_of(bundle).task.task == ABSENT
    assert settings_of(random_bundle).task.task == "car-racing"
    with pytest.raises(UsageError, match=r"--bundle .*none.*--task"):
        RunConfig(bundle="none")


@pytest.mark.parametrize(("world", "actions"), [("choices", 3), ("one number", 1)])
def test_controllers_have_the_outputs_of_the_world(tmp_path, world, actions):
    bundle = write_bundle_of(world, tmp_path / "b.zip")
    assert settings_of(bundle, task="dream").controller == ControllerShape(7, actions)
    assert settings_of(bundle, task="dream", features="z").controller == ControllerShape(3, actions)


@pytest.mark.parametrize("task", ["takecover", "gym:CartPole-v1"])
def test_a_world_model_of_another_world_is_refused(bundle, random_bundle, task):
    for each, world in ((bundle, ABSENT), (random_bundle, "car-racing")):
        with pytest.raises(UsageError, match=f"{world}.*{task}.*--bundle"):
            settings_of(each, task=task)


def preset_for(preset, bundle):
    changes = {"bundle": str(bundle.path), "subspace": None, "preset": preset}
    return freeze(RunConfig(**find_preset(preset) | changes), bundle)


def test_a_preset_fits_world_models_of_its_world_and_one_without_a_world_model_any(bundle, tmp_path):
    for preset in ("takecover", "real"):
        with pytest.raises(UsageError, match=f"{preset} .*b.zip .*{ABSENT}.*--preset"):
            preset_for(preset, bundle)
    for preset in ("pixels", "dream"):
        assert preset_for(preset, bundle).task.task == "dream"
    own = write_bundle_of("choices", tmp_path / "own.zip", task="takecover")
    assert preset_for("takecover", own).task.horizon == 525, "though it does not ship"


def test_a_gymnasium_environment_is_scored_with_a_world_model_of_its_own(tmp_path):
    bundle = write_bundle_of("choices", tmp_path / "b.zip", task="gym:Some-v0")
    assert settings_of(bundle, task="gym:Some-v0") == settings_of(bundle)


@pytest.mark.parametrize(
    ("flags", "names"),
    [
        ({"variant": ("pedals=one",)}, "pedals.* decide_every, feedback"),
        ({"variant": ("decide_every=0",)}, "decide_every .*50"),
        ({"task": "dream", "end": "soon"}, "'drawn'.*'soon'"),
        ({"task": "dream", "end": "1.5"}, "'drawn'.*1.5"),
        ({"end": "drawn"}, "--end .*dream"),
    ],
)
def test_what_the_world_does_not_have_is_refused(bundle, flags, names):
    with pytest.raises(UsageError, match=names):
        settings_of(bundle, **flags)


def test_an_end_rule_of_the_runs_own_is_another_version(bundle):
    assert bundle.manifest.world.end == DRAWN
    plain, own = settings_of(bundle, task="dream"), settings_of(bundle, task="dream", end="0.250")
    assert (own.task.end, own.task.version, own.task.world_version) == ("0.25", 3 + OWN_END_VERSION, 3)
    assert comes_back(own, bundle)
    assert own.task.digest("score", b"x", (1,)) != plain.task.digest("score", b"x", (1,))
    assert own.task.with_overrides(horizon=20).end == "0.25"
    assert settings_of(bundle, task="dream", end="drawn") == plain, "the bundle's own rule is no rule of the run's own"


def test_a_dream_of_the_first_world_may_have_an_end_too(random_bundle):
    plain = settings_of(random_bundle, task="dream")
    assert plain.task.horizon == 1000
    assert "end" not in to_plain(plain.task)
    assert settings_of(random_bundle, task="dream", end="0.5") == plain
    assert settings_of(random_bundle, task="dream", end="drawn").task.version == 1 + OWN_END_VERSION


@pytest.mark.parametrize("name", ["takecover", "takecover-real", "pixels"])
def test_presets_of_other_worlds_begin_on_their_bundles(tmp_path, name):
    facts = WorldFacts.of(one_hot(3), reward=RewardFacts("survival", gain=4.0), end=EndRule("drawn"), **ABOUT)
    bundle = write_world_bundle(tmp_path / "b.zip", facts, "takecover", vae=VAE, rnn=MODELS["choices"])
    preset = find_preset(name) | {"bundle": str(bundle.path)}
    settings = freeze(RunConfig(**preset), bundle)
    assert comes_back(settings, bundle)


@pytest.mark.parametrize(("limit", "given", "horizon"), [(200, None, 200), (5000, None, 1000), (200, 400, 400)])
def test_episodes_are_no_longer_than_the_bundles_world_unless_a_run_says_so(tmp_path, limit, given, horizon):
    facts = replace(WORLDS["choices"], horizon=limit)
    bundle = write_world_bundle(tmp_path / "b.zip", facts, ABSENT, vae=VAE, rnn=MODELS["choices"])
    preset = find_preset("pixels") | ({"horizon": given} if given else {})
    settings = settings_of(bundle, **preset)
    assert settings.task.horizon == horizon
    assert comes_back(settings, bundle)


def test_each_demonstration_has_a_world_model_that_ships():
    assert {DemoConfig(world=each).plan.bundle for each in shipped.WORLDS} <= set(shipped_names())
    with pytest.raises(UsageError, match=r"--world .*car-racing, takecover.*'moon'"):
        DemoConfig(world="moon")
