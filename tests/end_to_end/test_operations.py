"""Every verb accepts the configuration file of docs/how-to/configure.md; a run ends with its workers."""

import json
import re
from pathlib import Path

import pytest

from tests.support import tasks
from tests.support.processes import ROOT


def test_the_documented_file_is_accepted_by_every_kind_of_verb(processes):
    text = Path(ROOT / "docs" / "how-to" / "configure.md").read_text()
    path = processes.folder / "fleet.toml"
    path.write_text(re.search(r"```toml\n(.*?)```", text, re.DOTALL)[1].replace("/data/runs", str(processes.runs)))
    assert processes.call("runs", "list", "--config", path)[0] == 0
    _, _, err = processes.call("coordinator", "--resume", "absent", "--config", path)
    assert "'absent'" in err
    _, _, err = processes.call("worker", "--config", path, "--run", "No Good")
    assert "'No Good'" in err


@pytest.mark.slow
def test_a_run_ends_with_its_workers_and_one_of_any_run_waits_for_the_next(processes):
    coordinator = processes.coordinator("--task", tasks.SLOW_TOY, "--generations", 10**6, "--evaluate-every", 0)
    flags = ("--task", tasks.SLOW_TOY)
    own, anyone = processes.worker(*flags), processes.worker("--any", *flags)
    coordinator.wait_for_event("joined", times=2)  # the workers' own logs say it sooner
    code, out, _ = processes.call("stop", "test", "--workers", "--connect", processes.endpoint, "--json")
    assert code == 0
    assert json.loads(out)["asked"] == "disband"
    assert own.finish()[0] == 0
    assert coordinator.finish()[0] == 130
    anyone.wait_for_event("left", run="test")
    assert anyone.popen.poll() is None
