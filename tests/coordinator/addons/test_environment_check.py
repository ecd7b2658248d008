"""The check of a task before a run: coordinators of one sweep make it once."""

from dataclasses import replace

from dreamfleet.coordinator.addons import environment_check
from dreamfleet.coordinator.addons.environment_check import CHECKED, check_environment
from dreamfleet.coordinator.settings.config import RunConfig

CONFIG = RunConfig(task="function:tests.support.objectives:varying", environment=("x0=[0,0]",))


def test_coordinators_of_a_sweep_check_a_task_once_and_warn_alike(tmp_path, monkeypatch, caplog):
    calls = []
    real = environment_check.try_task
    monkeypatch.setattr(
        environment_check, "try_task", lambda *given, **more: calls.append(given) or real(*given, **more)
    )
    monkeypatch.setenv(CHECKED, str(tmp_path / "checks"))
    first, second = (check_environment(CONFIG, None, strict=False) for _ in range(2))
    assert first.description == second.description
    assert len(calls) == 1
    assert sum(CONFIG.task in each.getMessage() for each in caplog.records if each.levelname == "WARNING") == 2
    next((tmp_path / "checks").glob("*.json")).write_text("{")
    other = replace(CONFIG, environment=("x0=[0,0,0]",))
    assert check_environment(other, None, strict=False).description.outputs == 3
    assert check_environment(CONFIG, None, strict=False).description == first.description
    assert len(calls) == 3
