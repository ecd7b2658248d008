import pytest

from tests.support.doom import use_fake


@pytest.fixture
def fake_doom(monkeypatch):
    use_fake(monkeypatch)


@pytest.fixture(params=["stand-in", pytest.param("vizdoom", marks=pytest.mark.needs_doom)])
def doom(request, monkeypatch):
    if request.param == "stand-in":
        use_fake(monkeypatch)
