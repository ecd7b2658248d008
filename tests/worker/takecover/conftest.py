import tempfile

import pytest

from tests.support.doom import use_fake


@pytest.fixture
def fake_doom(monkeypatch):
    use_fake(monkeypatch)


@pytest.fixture(params=["stand-in", pytest.param("vizdoom", marks=pytest.mark.needs_doom)])
def doom(request, monkeypatch):
    if request.param == "stand-in":
        use_fake(monkeypatch)


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The folder of temporary files, of this process and of those that it starts."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.setenv("TMPDIR", str(folder))
    return folder
