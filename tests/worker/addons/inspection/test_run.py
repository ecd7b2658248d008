"""A run's page; `inspect --probe` and `inspect --losses`: what they print, and the allowed drivers; how long
policies live in dreams. Tests measure.py, measurements.py, survival.py and verb.py."""

import json
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.common.errors import UsageError
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.common.runs.records import RunSettings, StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.coordinator.jobs.evaluation import Evaluation
from dreamfleet.coordinator.jobs.scoring_job import vector_bytes
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.worker.addons.inspection import encoded_rollout, measurements, verb
from dreamfleet.worker.addons.inspection.dream_comparisons import LossReport, RoadLossComparison
from dreamfleet.worker.addons.inspection.encoded_rollout import DriveConfig, record_drive
from dreamfleet.worker.addons.inspection.page_builder import manifest_facts, write_page
from dreamfleet.worker.addons.inspection.probe import Estimate
from dreamfleet.worker.addons.inspection.subject import DriverChoice, InspectionSubject, find_subject
from dreamfleet.worker.addons.inspection.survival import (
    PolicySurvival,
    Survival,
    SurvivalConfig,
    fixed_drivers,
    measure_survival,
)
from dreamfleet.worker.tasks.api import World
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle, write_world_bundle
from tests.support.pixel_world import Dodge, DodgeTask
from tests.support.samples import SPEC
from tests.support.tables import cells
from tests.support.variants import controller_of
from tests.support.verbs import run_verb

COMPARED = RoadLossComparison("40 steps before", 30, {"lost": {"reality": Estimate(1.0, 0.0)}})

JUDGED = 0.5  # each parameter of the run's evaluated mean


@pytest.fixture
def runs_dir(tmp_path, random_bundle):
    path = tmp_path / "runs" / "night"
    path.mkdir(parents=True)
    shape = random_bundle.controller_shape
    spec = replace(SPEC, bundle=random_bundle.sha256, temperature=1.25)
    settings = RunSettings(spec, shape, 2, 1, 0.1, "diagonal", 1, 1, 2)
    journal = Journal.create(path, settings, random_bundle.path)
    vectors = [vector_bytes(np.full(shape.size, value)) for value in (JUDGED, 1.5)]
    for number in range(3):
        journal.open_generation(number, b"", 0.1, [7], vectors)
        closed = StoredGeneration(number, number, 1.0, number + 1, 0.0, 0.1, 20, 1.0)
        journal.close_generation(closed, np.array([0.0, 1.0]))
        journal.schedule_evaluation(Evaluation(number, vectors[0], 2))
        journal.finish_evaluation(number, StoredEvaluation(number, 4, 100.0 * number, 5.0), 0)
    journal.commit()
    journal.close()
    return tmp_path / "runs"


def end(runs_dir, bundle):
    """Keep a controller of the run, which has ended: its journal says with which parameters."""
    controller_of(bundle, "dream").save(runs_dir / "night" / CONTROLLER)


@pytest.mark.slow
def test_a_run_that_goes_on_is_driven_at_random_and_one_that_has_ended_by_its_controller(
    runs_dir, random_bundle, tmp_path
):
    with find_subject("night", runs_dir) as subject:
        assert subject.controller is None
        assert 'id="fitness"' in write_page(subject, tmp_path / "out", DriveConfig(steps=4)).read_text()
    end(runs_dir, random_bundle)
    with find_subject("night", runs_dir) as subject:
        assert (subject.controller.parameters == JUDGED).all()


def test_a_bundle_is_shown_a_drive_of_another_ones_controller(random_bundle, tmp_path):
    controller, _ = find_controller("tiny", tmp_path)
    own = find_bundle("tiny")
    seen, driven = (record_drive(each, controller, DriveConfig(steps=30), own) for each in (random_bundle, own))
    assert np.array_equal(seen.action, driven.action)
    assert not np.array_equal(seen.mu, driven.mu)


def test_a_runs_own_controller_is_measured_at_the_runs_temperature(runs_dir, random_bundle, monkeypatch):
    asked = []
    report = LossReport(1, 8, 1.0, 10, (COMPARED,))
    monkeypatch.setattr(measurements, "collect_losing_drives", lambda *_given: [])
    monkeypatch.setattr(measurements, "compare_losses", lambda *given: asked.append(given) or report)
    end(runs_dir, random_bundle)
    for flags, temperature in ((), 1.25), (("--temperature", "1.5"), 1.5):
        assert run_verb(verb, "night", "--losses", *flags, runs_dir=runs_dir) == 0
        _, bundle, controller, losses, _ = asked.pop()
        assert bundle.sha256 == controller.bundle == random_bundle.sha256
        assert losses.temperature == temperature


FOUND = {"z_linear", "z_network", "zh_linear", "zh_network"}


@pytest.mark.slow
def test_likeness_prints_how_often_dreams_come_to_what_is_rare(call):
    lines = call("tiny", "--likeness", "--controller", "tiny", "--episodes", "3", "--noise", "0.1").splitlines()
    assert cells(lines[0]) == ["quantity", "rare", "reality", "reality, foreseen", "dream"]
    rows = {cells(line)[0]: cells(line)[2:] for line in lines[1:-1]}
    assert "off_road" not in rows
    assert rows["curvature_20m"][0].startswith("0.1")


@pytest.mark.slow
def test_as_json_both_have_counts_values_and_errors(call):
    found = json.loads(call("--controller", "tiny", "--probe", "--losses", "--episodes", "4", "--json"))
    assert found["bundle"] == find_bundle("tiny").sha256
    assert found["probe"]["drives"] == 4
    for known in found["probe"]["known"]:
        assert set(known["found"]) == FOUND
        assert set(known["found"]["zh_linear"]) == {"value", "error"}
    begun = {each["begun"]: each for each in found["losses"]["begun"]}
    assert {"40 steps before", "20 steps before", "0 steps before"} <= set(begun)
    assert begun["40 steps before"]["count"] == 4
    assert begun["40 steps before"]["figures"]["lost"]["reality"] == {"value": 1.0, "error": 0.0}
    assert found["losses"]["temperature"] == 1.0


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("--losses",),
        ("tiny", "--driver", "held"),
        ("tiny", "--probe"),
        ("tiny", "--probe", "--controller", "tiny", "--driver", "held"),
        ("tiny", "--probe", "--driver", "ghost"),
        ("tiny", "--losses", "--driver", "held"),
        ("tiny", "--likeness", "--driver", "held"),
        ("tiny", "--losses", "--controller", "tiny", "--episodes", "3"),
        ("tiny", "--probe", "--controller", "tiny", "--noise", "nan"),
        ("tiny", "--losses", "--controller", "tiny", "--temperature", "0"),
    ],
)
def test_what_cannot_be_measured_is_reported_before_anything_is_driven(call, arguments):
    with pytest.raises(UsageError):
        call(*arguments)


def test_a_controller_of_another_world_model_dreams_nothing(tmp_path):
    bundle, (controller, _) = find_bundle("tiny"), find_controller("tiny", tmp_path)
    other = DriverChoice(replace(controller, bundle="0" * 64), bundle)
    with pytest.raises(UsageError):
        other.dream_controller(bundle)


VAE, ENDING = VAEConfig(latent=5, channels=(4, 4, 4, 8)), MDNRNNConfig(latent=5, hidden=8, reward="none", done=True)
FACTS = DodgeTask.world.facts(RewardFacts("survival"), EndRule("drawn"))
NAMES = ["always stay", "always left", "always right", "held", "uniform"]


@pytest.fixture(scope="module")
def dodge(tmp_path_factory):
    return write_world_bundle(tmp_path_factory.mktemp("dodge") / "dodge.zip", FACTS, vae=VAE, rnn=ENDING)


@pytest.fixture
def closed(monkeypatch):
    """The environments that were closed."""
    found = []
    monkeypatch.setattr(Dodge, "close", lambda environment: found.append(environment) or None)
    return found


def test_each_choice_each_driver_and_the_controller_live_in_both(dodge, closed):
    counts = []
    found = measure_survival(dodge, controller_of(dodge, "dream"), SurvivalConfig(3, first_seed=7), counts.append)
    assert [each.policy for each in found.policies] == [*NAMES, "controller"]
    assert counts == [*range(1, 19), *range(21, 37, 3)], "episodes of six policies, then of their dreams"
    assert (found.limit, found.end, len(closed)) == (200, "drawn", 1)
    assert all(1 <= each.real.value <= 200 and 1 <= each.dreamt.value <= 200 for each in found.policies)
    assert measure_survival(dodge, None, SurvivalConfig(3, first_seed=7)).policies == found.policies[:-1]


def test_the_rule_of_ends_decides_how_long_dreams_last(dodge):
    never, at_once = (measure_survival(dodge, None, SurvivalConfig(2, end=end)) for end in ("1", "0"))
    assert {(each.dreamt.value, each.dreamt_cut) for each in never.policies} == {(200.0, 1.0)}
    assert {(each.dreamt.value, each.dreamt_cut) for each in at_once.policies} == {(1.0, 0.0)}
    assert never.end == "1.0"


def test_figures_of_known_lengths():
    lengths = [np.array([10, 30]), np.array([40, 40])]
    one = PolicySurvival.of("one", *lengths, limit=40)
    assert (one.real, one.dreamt) == (Estimate(20.0, 10.0), Estimate(40.0, 0.0))
    assert (one.ratio, one.real_cut, one.dreamt_cut) == (Estimate(2.0, 1.0), 0.0, 1.0)
    other = PolicySurvival.of("other", lengths[1], lengths[0], limit=40)
    both = Survival.of(SurvivalConfig(), 40, "0.5", (one, other)).agreement
    assert both.value == pytest.approx(-np.log(2)), "too long and too short do not make up for each other"
    assert both.error == pytest.approx(np.hypot(0.5, 0.5) / 2)
    single = PolicySurvival.of("one", lengths[0][:1], lengths[1][:1], limit=40)
    assert (single.ratio.error, Survival.of(SurvivalConfig(), 40, "0.5", (single,)).agreement.error) == (None, None)


def test_numbers_are_held_at_their_bounds():
    world = World(Continuous.between([-1, 0], [1, 4]), action_names=("turn", "push"))
    drivers = fixed_drivers(DodgeTask(), world)
    actions = {name: drivers[name](None).act().tolist() for name in drivers if name.startswith("always")}
    assert actions == {
        "always the middle": [0, 2], "always turn -1": [-1, 2], "always turn 1": [1, 2], "always push 0": [0, 0],
        "always push 4": [0, 4],
    }  # fmt: skip


def test_a_model_without_ends_and_a_stranger_are_refused(dodge, tmp_path):
    endless = write_random_bundle(tmp_path / "endless.zip", vae=VAE, rnn=MDNRNNConfig(latent=5, hidden=8))
    with pytest.raises(UsageError, match=r"endless\.zip.*--set"):
        measure_survival(endless, None, SurvivalConfig(2))
    with pytest.raises(UsageError):
        measure_survival(dodge, controller_of(endless, "dream"), SurvivalConfig(2))


def test_the_verb_prints_a_row_a_policy_or_json(dodge, call):
    lines = call(str(dodge.path), "--survival", "--episodes", "2").splitlines()
    assert cells(lines[0]) == ["policy", "reality", "dream", "dream / reality", "cut, reality", "cut, dream"]
    assert [cells(line)[0] for line in lines[1:-1]] == NAMES
    found = json.loads(call(str(dodge.path), "--survival", "--episodes", "2", "--end", "0.5", "--json"))["survival"]
    assert (found["episodes"], found["end"], found["temperature"]) == (2, "0.5", 1.0)
    assert set(found["agreement"]) == {"value", "error"}
    assert set(found["policies"][0]["ratio"]) == {"value", "error"}


@pytest.mark.slow
def test_a_page_shows_a_world_of_choices(dodge, tmp_path, closed):
    page = write_page(InspectionSubject(dodge, controller_of(dodge, "dream")), tmp_path / "page", DriveConfig(steps=12))
    assert (page.parent / "ends.png").exists()
    assert not (page.parent / "rewards.png").exists(), "it predicts none"
    assert "CarRacing" not in page.read_text()
    assert dict(manifest_facts(dodge))["task"] == DodgeTask.name
    assert len(closed) == 1


def test_the_pages_drive_can_be_one_choice_by_its_number(dodge):
    driven = record_drive(dodge, None, DriveConfig(steps=4, action=(2.0,)))
    assert driven.action.tolist() == [[0, 0, 1]] * 4
    with pytest.raises(UsageError):
        record_drive(dodge, None, DriveConfig(action=(3.0,)))


def test_an_environment_is_closed_when_its_drive_fails(dodge, closed, monkeypatch):
    def fail(*_arguments):
        raise ValueError("it broke")

    monkeypatch.setattr(encoded_rollout, "run_episode", fail)
    with pytest.raises(ValueError, match="it broke"):
        record_drive(dodge, None, DriveConfig(steps=4))
    assert len(closed) == 1
