"""A search that keeps to a subspace: it continues to the bit, and leaves it from where it came to."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.artifacts.subspace import SearchSpace, Subspace
from dreamfleet.common.errors import ControllerError, JournalError, UsageError
from dreamfleet.common.runs.effort import Effort
from dreamfleet.common.runs.records import RunSettings, StageSettings
from dreamfleet.common.runs.run_provenance import RunProvenance
from dreamfleet.common.runs.stages import stages_of
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.coordinator.optimisers.evolution import Evolution
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.settings.start import stored_subspace
from dreamfleet.experiments.rerun import Rerun

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
