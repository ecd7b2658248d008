"""Run a tutorial's own code and commands in an empty folder, on a share of their numbers."""

import os
import re
import subprocess
import sys
from pathlib import Path

from tests.support.processes import DEADLINE, ROOT, free_port

WHOLE = 3 * DEADLINE  # seconds that a page's commands may take together


def run_page(page, shares, folder):
    """What a page's commands print, but for its first block, which installs; its Python is the module that it names."""
    text = (ROOT / "docs" / page).read_text()
    for code in _blocks(text, "python"):
        (module,) = set(re.findall(r"`(\w+\.py)`", text))
        (folder / module).write_text(code)
    install, *commands = _blocks(text, "sh")
    assert "pip install" in install
    script = "".join(commands)
    for whole, share in shares.items():
        assert whole in script
        script = script.replace(whole, share)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    own = {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}", "OMP_NUM_THREADS": "1",
        "DREAMFLEET_CACHE": str(folder / "cache"), "DREAMFLEET_LISTEN": endpoint, "DREAMFLEET_CONNECT": endpoint,
    }  # fmt: skip
    done = subprocess.run(
        ("bash", "-ec", script), cwd=folder, env={**os.environ, **own}, capture_output=True, text=True,
        timeout=WHOLE, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def _blocks(text, language):
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
