import shutil
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import Continuous, one_hot
from dreamfleet.common.artifacts.bundle import LINEAR_CONTROLLER, MANIFEST, POLICY, Bundle, write_bundle
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.car_racing_variants import FACTS, Variant
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.driving import WorldDriving
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts, WorldFacts
from dreamfleet.common.errors import BundleError, ControllerError, UsageError
from dreamfleet.worker.worlds.car_racing.task import WORLD
from tests.support.bundles import parts_of, rewrite, write_world_bundle

ABOUT = {
    "packages": ("numpy", "onnxruntime", "gymnasium"), "horizon": 200, "frames_per_second": 10, "score_word": "game",
    "reward": RewardFacts("survival"), "end": EndRule("drawn"), "marks": (100.0,),
}  # fmt: skip
KINDS = {"one-hot": one_hot(3), "thirds": Continuous.between([-1], [1])}
SIZES = {"one-hot": 3 * 289, "thirds": 289}


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def bundle(kind, tmp_path_factory):
    facts = WorldFacts.of(KINDS[kind], **ABOUT)
    return write_world_bundle(tmp_path_factory.mktemp("world") / "world.zip", facts)


def test_a_bundle_describes_its_world_and_its_controllers(bundle, kind):
    opened = Bundle.open(bundle.path, bundle.sha256)
    assert opened.manifest.world == WorldFacts.of(KINDS[kind], **ABOUT)
    assert not {POLICY, LINEAR_CONTROLLER} & opened.manifest.parts.keys()
    assert bundle.controller_shape.size == SIZES[kind]
    assert bundle.shape_of("z", hidden=5).size == 5 * 33 + KINDS[kind].outputs * 6
    seen = bundle.with_options(None, '{"feedback": "last"}')
    assert seen.controller_shape.features == 288 + 2 * KINDS[kind].outputs
    assert seen.driving == WorldDriving(bundle.manifest.world, feedback="last")


def test_a_controller_belongs_to_its_bundle_and_no_other(bundle, random_bundle):
    def controller(options):
        shape = bundle.with_options(None, options).controller_shape
        return Controller(shape, np.zeros(shape.size, np.float32), "dream", bundle.sha256, options=options)

    for options in ("", '{"decide_every": 3}'):
        assert bundle.for_controller(controller(options)).driving.options == options
    with pytest.raises(UsageError, match="pedals"):
        bundle.for_controller(replace(controller(""), options='{"pedals": "one"}'))
    with pytest.raises(ControllerError, match=r"world\.zip"):
        bundle.with_controllers(replace(bundle.controller_shape, features=7))
    with pytest.raises(BundleError, match=r"world\.zip .*DodgeTask .*pedals"):
        bundle.with_controllers(None, Variant(pedals="one"))
    with pytest.raises(UsageError, match=r"world\.zip"):
        bundle.variant  # noqa: B018 - reading it fails


def test_what_cannot_be_is_refused(bundle, tmp_path):
    parts = parts_of(bundle)
    with pytest.raises(BundleError, match=r"a\.zip"):
        write_bundle(tmp_path / "a.zip", replace(bundle.manifest, actions=2), parts)
    for wrong in (None, "x", float("nan"), True):
        manifest = replace(bundle.manifest, models={"mdnrnn": {"reward_scale": wrong}})
        with pytest.raises(BundleError, match="reward_scale"):
            write_bundle(tmp_path / "a.zip", manifest, parts)
    rewritten = shutil.copy(bundle.path, tmp_path / "c.zip")
    rewrite(rewritten, lambda name, data: data.replace(b'"low": [', b'"low": [9.5, ') if name == MANIFEST else data)
    with pytest.raises(BundleError, match=r"c\.zip"):
        Bundle.open(rewritten)


def test_a_bundle_says_its_world_and_car_racings_has_variants(random_bundle, tmp_path):
    assert random_bundle.manifest.world == find_bundle("tiny").manifest.world == FACTS
    assert WORLD.facts(FACTS.reward, EndRule()) == FACTS
    assert FACTS.actions == Variant().controls
    moon = write_bundle(tmp_path / "m.zip", replace(random_bundle.manifest, task="moon"), parts_of(random_bundle))
    assert moon.driving == WorldDriving(FACTS)
    rewrite(moon.path, lambda name, data: data.replace(b'"world"', b'"earth"') if name == MANIFEST else data)
    with pytest.raises(BundleError, match=r"m\.zip.*world"):
        Bundle.open(moon.path)
