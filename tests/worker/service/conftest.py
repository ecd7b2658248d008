import hashlib

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import BundleManifest, write_bundle
from dreamfleet.common.artifacts.bundle_store import BundleStore, default_cache
from dreamfleet.common.artifacts.car_racing_variants import FACTS
from dreamfleet.common.protocol.messages import MAX_PART
from tests.support.bundles import npy
from tests.support.slot_harness import Harness
from tests.support.stage import Stage, listening

PARTS = 6  # of the small bundle


@pytest.fixture(scope="module")
def small_bundle(tmp_path_factory):
    """A bundle with placeholder bytes as its world model, which the toy tasks do not read."""
    parts = dict.fromkeys(("encoder.onnx", "decoder.onnx"), b"x")
    parts["initial_latents.npy"] = npy(np.zeros((1, 2, 4), np.float32))
    manifest = BundleManifest("small", "toy", "none", (64, 64, 3), latent=4, hidden=4, actions=3, world=FACTS)
    path = tmp_path_factory.mktemp("bundle") / "small.zip"
    content = hashlib.sha256(b"a").digest() * ((PARTS - 1) * MAX_PART // 32)  # no part of it is plain
    return write_bundle(path, manifest, {**parts, "dream.onnx": content})


@pytest.fixture
def cached(small_bundle):
    with BundleStore(default_cache()).lock_download(small_bundle.sha256) as path:
        path.write_bytes(small_bundle.path.read_bytes())
    BundleStore(default_cache()).finish_download(small_bundle.sha256)


@pytest.fixture
def stage(small_bundle):
    made = Stage(small_bundle)
    yield made
    made.close()


@pytest.fixture
def said():
    """The log of a worker, for `wait_for`."""
    with listening() as lines:
        yield lines


@pytest.fixture
def harness(random_bundle):
    """Makes slots of a task, with another bundle than the random one if given."""
    made = []

    def make(task, bundle=None, **more):
        made.append(Harness(task, bundle or random_bundle.path, **more))
        return made[-1]

    yield make
    for each in made:
        each.slot.stop()
