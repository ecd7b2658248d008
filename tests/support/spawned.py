"""Words of `spawn`, and the rows that it prints."""

import json
import sys

from tests.support.processes import DEADLINE


def words(hosts, *more):
    return ("--ssh", hosts.ssh, "--remote-python", sys.executable, *more)


def rows_of(processes, *arguments, code=0, patience=DEADLINE):
    """The rows that a verb prints, by host."""
    done, out, err = processes.call(*arguments, "--json", timeout=patience)
    assert done == code, err
    return {row["host"]: row for row in json.loads(out.splitlines()[-1])["hosts"]}
