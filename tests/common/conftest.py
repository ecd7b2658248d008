import pytest

from tests.support.mutations import Watched


@pytest.fixture
def watched():
    made = Watched()
    yield made
    made.check()
