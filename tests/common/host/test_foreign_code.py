import os
import threading
from pathlib import Path

from dreamfleet.common.host import foreign_code
from dreamfleet.common.host.descendants import VARIABLE
from dreamfleet.common.host.foreign_code import contained


def test_code_that_takes_long_is_named(monkeypatch):
    monkeypatch.setattr(foreign_code, "SLOW", 0.0)
    said = threading.Event()
    lines = []
    monkeypatch.setattr(foreign_code.log, "warning", lambda text, *values: (lines.append(text % values), said.set()))
    with contained("making it"):
        assert said.wait(60)
    assert len(lines) == 1
    assert "making it" in lines[0]


def test_a_current_folder_that_is_gone_is_no_error(tmp_path, monkeypatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    with contained("it"):
        mark = os.environ[VARIABLE]
        with contained("another inside"):
            assert os.environ[VARIABLE] == mark, "it starts no second guard"
        os.chdir(tmp_path)
    assert Path.cwd() == tmp_path
    assert VARIABLE not in os.environ
