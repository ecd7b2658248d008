"""Workers on hosts whose login shell is no Bourne shell, or whose startup files print, hang, or print without end."""

import pytest

from tests.support.processes import DEADLINE
from tests.support.programs import find_program
from tests.support.spawned import rows_of, words

BASH = 'BASH_ENV=$HOME/.bashrc exec bash -c "$SSH_ORIGINAL_COMMAND"'  # as bash reads it under sshd
FISH, TCSH = (f'exec {shell} -c "$SSH_ORIGINAL_COMMAND"' for shell in ("fish", "tcsh"))  # as sshd calls a login shell
SHELLS = {
    "fish": (FISH, ".config/fish/config.fish", "echo 'dreamfleet-host, but not ours: welcome to $fish'"),
    "tcsh": (TCSH, ".cshrc", "echo 'Welcome!'"),
    "banner": (BASH, ".bashrc", "echo Welcome; echo 'Do not disturb' >&2; printf 'no line end'"),
    "hanging": (BASH, ".bashrc", "sleep 1000"),
    "endless": (BASH, ".bashrc", "while :; do echo Welcome; done"),
    "waiting": (BASH, ".bashrc", "read -r answer; exit 0"),
}
GOOD = ("fish", "tcsh")


@pytest.mark.long
@pytest.mark.needs_programs("sshd", "ssh", "fish", "tcsh")
def test_any_login_shell_serves_and_a_broken_one_is_one_row(processes, hosts):
    for name, (command, file, text) in SHELLS.items():
        path = (
            hosts.add(name, ForceCommand=command, path=f"{find_program('fish').rpartition('/')[0]}:/usr/bin:/bin").home
            / file
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n")
    spawn = ("spawn", *SHELLS, "--connect", processes.endpoint, "--no-tunnel", "--slots", 1, *words(hosts))
    rows = rows_of(processes, *spawn, code=1, patience=3 * DEADLINE)
    assert {name: rows[name]["state"] for name in ("fish", "tcsh", "banner")} == dict.fromkeys(
        ("fish", "tcsh", "banner"), "started"
    )
    assert " 60 " in rows["hanging"]["what"]
    assert " 1 " in rows["endless"]["what"]
    assert rows["waiting"]["state"] == "failed"
    down = rows_of(processes, "down", "fish", "tcsh", "banner", "--now", "--ssh", hosts.ssh)
    assert {row["state"] for row in down.values()} == {"left"}
