"""The configuration file that docs/operations.md shows is one that every verb accepts."""

import re
from pathlib import Path

from tests.support.processes import ROOT


def test_the_documented_file_is_accepted_by_every_kind_of_verb(processes):
    text = Path(ROOT / "docs" / "operations.md").read_text()
    path = processes.folder / "fleet.toml"
    path.write_text(re.search(r"```toml\n(.*?)```", text, re.DOTALL)[1].replace("/data/runs", str(processes.runs)))
    assert processes.call("runs", "list", "--config", path)[0] == 0
    _, _, err = processes.call("coordinator", "--resume", "absent", "--config", path)
    assert "no run 'absent'" in err
    _, _, err = processes.call("worker", "--config", path, "--run", "No Good")
    assert "cannot name a run" in err
