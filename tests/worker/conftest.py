import pytest

from tests.support.bundles import states
from tests.support.dreams import MODELS, VAE, WORLDS, write_bundle_of


@pytest.fixture(scope="session", params=WORLDS)
def world(request):
    return request.param


@pytest.fixture(scope="session")
def world_bundle(world, tmp_path_factory):
    recorded = states(9, VAE, MODELS[world])
    return write_bundle_of(world, tmp_path_factory.mktemp("worlds") / f"{world}.zip", recorded)


@pytest.fixture(scope="session")
def choices_bundle(tmp_path_factory):
    return write_bundle_of("choices", tmp_path_factory.mktemp("choices") / "choices.zip", seed=3)
