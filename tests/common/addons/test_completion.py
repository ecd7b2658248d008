"""`dreamfleet completion` writes scripts that complete in real shells."""

import re
import subprocess

import pytest

from dreamfleet.common.cli import command_line
from tests.support.processes import DEADLINE

# What bash does for a person who types the words and presses Tab.
PRESS_TAB = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMP_LINE="$*"; COMP_POINT=${#COMP_LINE}
$(complete -p dreamfleet | sed 's/.*-F \\([^ ]*\\).*/\\1/') dreamfleet "${COMP_WORDS[COMP_CWORD]}"
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        (("coord",), {"coordinator"}),
        (("verify", ""), {"run", "report", "candidate"}),
        (("runs", "re"), {"receipt"}),
        (("coordinator", "--popul"), {"--population"}),
        (("train", "mdn"), {"mdnrnn"}),
    ],
)
def test_bash_completes_verbs_and_flags(tmp_path, capsys, typed, offered):
    assert command_line.main(["completion", "bash"]) == 0
    script = tmp_path / "dreamfleet.bash"
    script.write_text(capsys.readouterr().out)
    command = ["bash", "-c", PRESS_TAB, "-", script, "dreamfleet", *typed]
    done = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE, check=True)
    assert offered <= {line.strip() for line in done.stdout.splitlines()}, done.stderr


def test_other_shells_get_scripts_too(capsys):
    for shell in ("zsh", "fish"):
        assert command_line.main(["completion", shell]) == 0
        assert re.search("coordinator.*population", capsys.readouterr().out, re.DOTALL)
