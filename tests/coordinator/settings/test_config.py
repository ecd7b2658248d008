"""Tests config.py, freezing.py, limits.py, network.py, presets.py, resume_settings.py, common/cli/bounds.py and
common/addons/worlds/car_racing.py."""

import json
from contextlib import closing

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.cli.config import load
from dreamfleet.common.cli.global_config import GlobalConfig
from dreamfleet.common.errors import ControllerError, DreamfleetError, JournalError, UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import Description
from dreamfleet.common.runs.lookup import find_subspace
from dreamfleet.common.runs.records import RunSettings, StageSettings
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.common.transport.network import DEFAULT_ENDPOINT
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.settings.presets import PRESETS, find_preset
from dreamfleet.coordinator.settings.resume_settings import (
    choose_addresses,
    serving_facts,
    stored_limits,
    stored_network,
)
from dreamfleet.coordinator.settings.start import StartPoint
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.worker.tasks.api import Task
from tests.support.bundles import states, write_random_bundle
from tests.support.frozen_settings import comes_back


@pytest.mark.parametrize(
    ("flags", "size"),
    [
        ({}, 867),
        ({"features": "z"}, 99),
        ({"controller": "hidden"}, 8 * 289 + 3 * 9),
        ({"hidden_units": 24, "features": "z"}, 867),
        ({"controller": "linear"}, 867),
        ({"controller": "hidden", "hidden_units": 24, "features": "z"}, 867),  # as long as the linear one on z and h
    ],
)
def test_a_runs_controller_is_as_configured_and_journalled(random_bundle, flags, size):
    config = RunConfig(bundle=str(random_bundle.path), **flags)
    settings = freeze(config, random_bundle)
    assert settings.controller.size == size
    assert (settings.task.controller is None) == (settings.controller == random_bundle.default_shape)
    assert comes_back(settings, random_bundle)


@pytest.mark.parametrize("name", sorted(PRESETS.keys() - {"takecover", "takecover-real", "pixels"}))
def test_a_preset_of_a_run_is_one_that_can_begin_and_be_configured_again(name):
    bundle = find_bundle("tiny")
    preset = dict(PRESETS[name])
    loaded_subspace = find_subspace(preset["subspace"]) if "subspace" in preset else None
    settings = freeze(RunConfig(**preset, loaded_subspace=loaded_subspace), bundle)
    assert comes_back(settings, bundle, loaded_subspace=loaded_subspace)


@pytest.mark.parametrize(
    "sources", [{"file": {"run": {"hidden_units": 16}}}, {"environment": {"DREAMFLEET_RUN_HIDDEN_UNITS": "16"}}]
)
def test_units_of_a_layer_make_the_layer_wherever_they_are_given(sources):
    config = load(RunConfig, "run", **sources, base={"task": "gym:CartPole-v1"})
    assert freeze(config, None).controller.hidden == 16


def test_a_run_that_says_nothing_keeps_the_words_of_the_first_version(random_bundle):
    text = json.loads(freeze(RunConfig(), random_bundle).to_json())
    assert text["controller"] == {"features": 288, "actions": 3}
    assert not {"features", "racing", "optimiser", "optimiser_options"} & text.keys()
    assert "controller" not in text["task"]
    assert RunSettings.from_json(json.dumps(text)).optimiser == "cma"
    said = RunConfig(variant=("pedals=two", "decide_every=1", "feedback=none"))
    assert json.loads(freeze(said, random_bundle).to_json()) == text


def test_jobs_of_other_controllers_have_other_digests(random_bundle):
    plain = TaskSpec("car-racing", "ab" * 32, 10, 0)
    other = TaskSpec("car-racing", "ab" * 32, 10, 0, random_bundle.shape_of("z", 24))
    assert plain.digest("score", b"x", (1,)) != other.digest("score", b"x", (1,))
    assert to_plain(other)["controller"] == {"features": 32, "actions": 3, "hidden": 24}


def test_a_share_of_recorded_states_is_frozen_with_a_dream_and_can_be_configured_again(tmp_path):
    bundle = write_random_bundle(tmp_path / "b.zip", recorded=states(3))
    settings = freeze(RunConfig(task="dream", recorded=0.5), bundle)
    assert (settings.task.recorded, settings.task.version, settings.task.options) == (0.5, 1, "")
    assert comes_back(settings, bundle)
    plain = freeze(RunConfig(task="dream"), bundle)
    assert "recorded" not in plain.to_json()
    assert freeze(RunConfig(task="dream", recorded=0.0), bundle) == plain
    assert settings.task.digest("score", b"x", (1,)) != plain.task.digest("score", b"x", (1,))
    assert settings.task.with_overrides(100, 50).recorded == 0.5


@pytest.mark.parametrize(
    ("texts", "options", "shape"),
    [
        (("pedals=one", "pedal_shift=0.25"), {"pedal_shift": 0.25, "pedals": "one"}, (288, 2)),
        (("feedback=last", "pedals=one"), {"feedback": "last", "pedals": "one"}, (292, 2)),
        (("time_cost=1",), {"time_cost": 1.0}, (288, 3)),
    ],
)
def test_a_variant_is_frozen_with_a_run_and_can_be_configured_again(random_bundle, texts, options, shape):
    settings = freeze(RunConfig(variant=texts), random_bundle)
    assert json.loads(settings.task.options) == options
    assert (settings.controller.features, settings.controller.actions) == shape
    assert (settings.task.controller is None) == (shape == (288, 3))
    assert comes_back(settings, random_bundle)
    plain = freeze(RunConfig(), random_bundle)
    assert settings.task.digest("score", b"x", (1,)) != plain.task.digest("score", b"x", (1,))
    assert freeze(RunConfig(variant=texts, task="dream"), random_bundle) if "time_cost=1" not in texts else True


def test_a_run_of_task_dream_that_drives_too_may_charge_its_drives(random_bundle):
    for driven in ({"driven": 1.0}, {"stages": (StageSettings(5), StageSettings(driven=0.5, episodes=2))}):
        found = freeze(RunConfig(task="dream", variant=("offroad_cost=2",), **driven), random_bundle)
        assert found.task.options == '{"offroad_cost": 2.0}'


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"variant": ("pedal=one",)}, r"pedal\b.*pedals, pedal_shift, decide_every, "),
        ({"variant": ("pedals",)}, "--variant 'pedals'"),
        ({"variant": ("pedals=one", "pedals=one")}, "--variant"),
        ({"variant": ("offroad_cost=2",), "task": "dream"}, "offroad_cost"),
        ({"preset_variant": ("offroad_cost=2",), "task": "dream"}, "offroad_cost.*--variant"),
        ({"variant": ("pedals=one",), "task": "tests.support.tasks:Toy"}, "tests.support.tasks:Toy"),
        ({"task_options": '{"pedals": "one"}'}, "--task-options"),
        ({"task": "dream", "recorded": -0.1}, "--recorded"),
        ({"task": "dream", "recorded": 1.5}, "--recorded"),
        ({"recorded": 0.5}, "--recorded"),
        ({"task": "gym:CartPole-v1", "recorded": 0.5}, "--recorded"),
        ({"task": "dream", "recorded": 0.5}, "--recorded"),  # the bundle holds no such states
        ({"optimiser": "cmea"}, "'cmea'"),
        pytest.param({"optimiser": "cmaes-sep", "covariance": "full"}, "--covariance", marks=pytest.mark.add_on),
        ({"optimiser_options": ("restarts=3",)}, "'restarts'.* covariance"),
        ({"population": 2}, "867 .*--population"),
        ({"controller": "hidden", "hidden_units": 10**5, "covariance": "full"}, "--covariance"),
        ({"controller": "hidden", "hidden_units": 10**5, "population": 10**5}, "--hidden-units.*--population"),
        ({"horizon": 2_000_000}, "--horizon .*1000000"),
        ({"patience": 10**8}, "--patience .*1000000"),
        ({"seed": 10**20}, "--seed"),
        ({"population": 10**11}, "--population .*100000"),
        ({"hidden_units": 10**12}, "--hidden-units .*100000"),
        ({"hidden_units": 0}, "--hidden-units .*100000"),
        ({"controller": "linear", "hidden_units": 16}, "--hidden-units .*--controller"),
        *(({"temperature": each}, "--temperature") for each in (0.0, -1.0, 5000.0, float("nan"), float("inf"))),
        ({"sigma0": 1e300}, "--sigma0"),
        ({"task": ""}, r"\bgym\b"),
        ({"task": "a b:x"}, "a b:x"),
        ({"task": "car-racng"}, "car-racing"),
        ({"task": "gymm:CartPole-v1"}, r"gym\b"),
    ],
)
def test_what_a_run_cannot_be_is_refused_in_one_line_before_there_is_one(random_bundle, changes, names):
    with pytest.raises(DreamfleetError, match=names) as error:
        freeze(RunConfig(**changes), random_bundle)
    assert "\n" not in str(error.value)


def test_a_start_that_drives_otherwise_or_is_of_another_length_is_refused_and_one_that_pays_otherwise_is_not(
    random_bundle,
):
    one_pedal = StartPoint(np.zeros(578), random_bundle.sha256, "run night", '{"pedals": "one"}')
    plain = StartPoint(np.zeros(867), random_bundle.sha256, "run night")
    one_pedal.check(freeze(RunConfig(variant=("pedals=one", "time_cost=1")), random_bundle), random_bundle)
    plain.check(freeze(RunConfig(), random_bundle), random_bundle)
    for start, changes, names in (
        (one_pedal, {}, r'run night .*{"pedals": "one"}.*--variant'),
        (one_pedal, {"variant": ("pedals=one", "decide_every=4")}, r'run night .*{"pedals": "one"}.*--variant'),
        (plain, {"variant": ("decide_every=4",)}, r'{"decide_every": 4}'),
        (plain, {"features": "z"}, r"867 .*99"),
    ):
        with pytest.raises(ControllerError, match=names):
            start.check(freeze(RunConfig(**changes), random_bundle), random_bundle)
    assert freeze(one_pedal.apply_to(RunConfig()), random_bundle).task.options == one_pedal.options


HALF, HELD = '{"pedals": "half"}', '{"decide_every": 2, "pedals": "half"}'


@pytest.mark.add_on
@pytest.mark.parametrize(
    ("texts", "options"),
    [((), HALF), (("decide_every=2",), HELD), (("pedals=two",), ""), (("pedals=one",), '{"pedals": "one"}')],
)
def test_what_is_said_of_a_variant_is_stronger_than_the_presets_name_by_name(random_bundle, texts, options):
    found = load(RunConfig, "run", file={"run": {"preset": "article", "variant": list(texts)}}, preset=find_preset)
    assert freeze(found, random_bundle).task.options == options


@pytest.mark.add_on
def test_a_preset_with_a_world_model_is_of_that_world_alone_and_a_variant_of_those_that_have_one():
    article, real = (
        load(RunConfig, "run", file={"run": {"preset": preset, "task": "gym:CartPole-v1"}}, preset=find_preset)
        for preset in ("article", "real")
    )
    assert freeze(article, None).task == freeze(RunConfig(task="gym:CartPole-v1"), None).task
    with pytest.raises(UsageError, match=r"real .*car-racing.*gym:CartPole-v1.*--preset"):
        freeze(real, None)


ARTICLE = {"preset": "article", "preset_variant": ("pedals=half",)}
REAL = {"preset": "real", "preset_variant": ("offroad_cost=0.5",)}


@pytest.mark.parametrize(
    ("preset", "own", "texts", "options"),
    [
        (ARTICLE, "", (), ""),
        (ARTICLE, HALF, (), HALF),
        (ARTICLE, HALF, ("time_cost=1",), '{"pedals": "half", "time_cost": 1.0}'),
        (ARTICLE, '{"decide_every": 2, "time_cost": 1.0}', (), '{"decide_every": 2, "time_cost": 1.0}'),
        (ARTICLE, '{"decide_every": 2, "time_cost": 1.0}', ("offroad_cost=2",),
         '{"decide_every": 2, "offroad_cost": 2.0}'),
        (REAL, "", (), '{"offroad_cost": 0.5}'),
        (REAL, '{"offroad_cost": 2.0}', (), '{"offroad_cost": 0.5}'),
        (REAL, HALF, ("offroad_cost=1",), '{"offroad_cost": 1.0, "pedals": "half"}'),
        (REAL | {"task": "dream"}, '{"offroad_cost": 2.0, "pedals": "half"}', ("offroad_cost=0",), HALF),
        ({"task": "dream"}, '{"offroad_cost": 2.0}', (), ""),
    ],
)  # fmt: skip
def test_a_start_keeps_its_way_of_driving_and_a_preset_says_what_candidates_pay(
    random_bundle, preset, own, texts, options
):
    start = StartPoint(np.zeros(867), random_bundle.sha256, "run night", own)
    settings = freeze(start.apply_to(RunConfig(variant=texts, **preset)), random_bundle)
    start.check(settings, random_bundle)
    assert settings.task.options == options


def test_an_optimiser_is_journalled_and_can_be_configured_again(random_bundle):
    config = RunConfig(
        optimiser="tests.support.optimisers:ParentsAndChildren", optimiser_options=("parents=2", ""), features="z"
    )
    settings = freeze(config, random_bundle)
    assert settings.optimiser_options == ("parents=2",)
    assert comes_back(settings, random_bundle)


class Field(Task):
    """Needs no bundle, and says so."""

    name = "field"

    def describe(self, options):
        return Description(2, 2)


def test_a_task_that_describes_itself_needs_no_bundle(random_bundle):
    config = RunConfig(task=f"{__name__}:Field")
    assert config.needs_no_bundle
    assert freeze(config, None).task.bundle == ""
    assert RunConfig(task="takecover").needs_no_bundle
    named = [{"task": "takecover", "bundle": "b.zip"}, {"task": "no.such.module:Task", "bundle": "tiny"}]
    for flags in ({}, {"task": "dream"}, {"task": "car-racing"}, *named):
        assert not RunConfig(**flags).needs_no_bundle
    for unknown, names in {"moon": "'moon'", "no.such.module:Task": "--trust"}.items():
        with pytest.raises(UsageError, match=f"{names}.*--bundle"):
            _ = RunConfig(task=unknown).needs_no_bundle
    with pytest.raises(UsageError, match="gym:CartPole-v1"):
        freeze(RunConfig(task="gym:CartPole-v1", bundle="tiny"), random_bundle)


def test_the_chosen_keys_of_an_observation_are_frozen_and_described_again(tmp_path):
    task = "gym:tests.support.pixel_fakes:Telling-v0"
    settings = freeze(RunConfig(task=task, observation=("hand",)), None)
    assert settings.task.option("observation") == ["hand"]
    again = RunConfig(task=task, task_options=settings.task.options)
    assert freeze(again, None).controller == settings.controller
    assert settings.controller.features == 3


@pytest.mark.parametrize(
    ("changes", "flag"),
    [
        ({"environment": ("x=1", "x=2")}, "--environment"),
        ({"task_options": '{"normal": {"mean": [1], "deviation": [0]}}'}, "--task-options"),
        ({"task_options": "{"}, "--task-options"),
    ],
)
def test_options_that_describe_no_world_are_refused(changes, flag):
    with pytest.raises(UsageError, match=flag):
        freeze(RunConfig(task="gym:CartPole-v1", **changes), None)


HERE, THERE, FAR = "tcp/0.0.0.0:7610", "tcp/there:1", "tcp/far:2"


@pytest.fixture
def folder(tmp_path, random_bundle):
    Journal.create(tmp_path, freeze(RunConfig(), random_bundle), random_bundle.path).close()
    return tmp_path


def keep(folder, facts):
    with closing(Journal(folder / "journal.sqlite")) as journal:
        for each in facts.items():
            journal.set_fact(*each)
        journal.commit()


def test_limits_and_network_come_back_as_they_were_and_defaults_are_not_written(folder):
    assert serving_facts(LimitsConfig(), NetworkConfig()) == {"limits": "{}", "network": "{}"}
    limits, network = LimitsConfig(minutes=30.0, target=900.0), NetworkConfig((HERE,), (), 0.2, strict=True)
    keep(folder, serving_facts(limits, network))
    with RunFolder(folder) as run:
        assert LimitsConfig(**stored_limits(run)) == limits
        assert NetworkConfig(**stored_network(run)) == network


@pytest.mark.parametrize("text", ["not JSON", "[]", '{"minutes": "many"}', json.dumps({"patience": 3})])
def test_what_is_damaged_or_of_a_later_version_is_said(folder, text):
    keep(folder, {"limits": text})
    with RunFolder(folder) as run, pytest.raises(JournalError, match=f"limits .*{folder.name}"):
        stored_limits(run)


@pytest.mark.parametrize(
    ("own", "site", "kept", "addresses"),
    [
        ({}, {}, {}, ((DEFAULT_ENDPOINT,), ())),
        ({}, {}, {"listen": (HERE,)}, ((HERE,), ())),
        ({}, {}, {"connect": (THERE,)}, ((), (THERE,))),
        ({"listen": (FAR,)}, {}, {"listen": (HERE,), "connect": (THERE,)}, ((FAR,), ())),
        ({"connect": (FAR,)}, {}, {"listen": (HERE,)}, ((), (FAR,))),
        ({"listen": (HERE,), "connect": (THERE,)}, {}, {}, ((HERE,), (THERE,))),
        # One file for the whole fleet: the coordinator listens, and does not connect to itself.
        ({}, {"listen": (HERE,), "connect": (THERE,)}, {}, ((HERE,), ())),
        ({}, {"connect": (THERE,)}, {}, ((), (THERE,))),
        ({}, {"connect": (THERE,)}, {"listen": (HERE,)}, ((HERE,), ())),
        ({"listen": (HERE,)}, {"connect": (THERE,)}, {}, ((HERE,), ())),
    ],
)
def test_addresses_are_as_configured_else_as_stored_else_this_host_alone(own, site, kept, addresses):
    chosen = choose_addresses(NetworkConfig(**own), GlobalConfig(**site), kept)
    assert (chosen.listen, chosen.connect) == addresses
