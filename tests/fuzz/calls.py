"""Command lines with odd values: each verb's valid words, one or two of its arguments replaced."""

import argparse
import random
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from shutil import copytree

from dreamfleet.common.addons.access.authority import Authority
from dreamfleet.common.cli.command_line import GROUP, build_parser, load_verb
from tests.support.drives import write_drives

FIXTURES = Path(__file__).parents[1] / "fixtures"
REPORT = Path(__file__).parents[2] / "docs" / "lab" / "results" / "tiny.json"
LISTEN = "--listen tcp/127.0.0.1:7400"
NETWORK = f"{LISTEN} --minutes 0.003"
RUN = "--task dream --bundle tiny --population 4 --episodes 1"
# Words that a verb accepts, in a folder that `write_stage` made; a verb of a plug-in has none.
VALID = {
    "access.init": "--access-dir new", "access.issue": "worker x --out x.join", "access.list": "",
    "access.revoke": "w", "baseline.export": "tiny --data data --out b.lean",
    "baseline.train": "tiny --data new --episodes 1 --steps 4",
    "bundle": "--data data --out new.zip", "collect": "--data new --episodes 1 --steps 2 --jobs 1",
    "completion": "bash", "compare": "report.json report.json", "lab.contrast": "--data data --out new --kind lr 1e-3",
    "coordinator": f"--run new {RUN} {NETWORK}", "dashboard": "--port 0", "demo": "--no-page --workers 1",
    "doctor": "", "down": "nowhere.invalid", "drain": "", "drive": "--steps 2", "encode": "--data data",
    "evaluate": "--controller tiny --episodes 1 --jobs 1", "inspect": "tiny",
    "iterate": f"--data data --rounds 1 {LISTEN}", "live": "--controller tiny --seconds 0.1",
    "lab.bench": "policy", "pause": "", "pipeline": "--data new --scale 0.001", "record": "--controller tiny --steps 2",
    "lab.refit": "tiny --to tiny --data data --out new.npz", "verify.run": f"tiny --run new {LISTEN}",
    "verify.candidate": "reality --candidate best", "verify.report": "report.json --episodes 1 --jobs 1", "resume": "",
    "router": LISTEN, "runs.archive": "dream", "runs.backup": "dream --to new",
    "runs.delete": "dream --yes", "runs.export": "dream --csv --out new",
    "runs.list": "", "runs.plot": "dream", "runs.receipt": "reality", "runs.show": "dream",
    "spawn": "nowhere.invalid", "status": "", "stop": "", "story": "", "lab.subspace": "tiny --data data --out new.npz",
    "tasks": "", "train": "vae --data data --updates 1 --batch 2",
    "worker": "--connect tcp/127.0.0.1:7400 --lifetime 0.01",
}  # fmt: skip
# No path of these leads out of the scratch folder, except to devices.
VALUES = (
    "", "--", "-", "-1", "0", "1", "2", "0.5", "1e309", "1" + "0" * 400, "-1e-320", "nan", "inf", "-inf", "±ünï",
    "\udcff\udc80", "a\nb\x1b[2J", "x" * 5000, "%s%(a)d{}", "[1", "a=b", "a=[[1e999]]", "none", "None", "true",
    " ", "..", "../..", "folder", "/dev/null", "/dev/full", "/dev/zero", "missing/path", "binary", "pipe", "other.npz",
    "report.json", "w-issued.join", "tcp/127.0.0.1:1", "tcp/127.0.0.1:99999999", "tcp/[::1", "dream",
    "empty", "'", "3-1", "0/0", "0/99999", "gym:CartPole-v1", "gym:", "1,2,,3", "18446744073709551616",
    "9223372036854775807", "-9223372036854775809",
)  # fmt: skip


@dataclass(frozen=True)
class Call:
    """A verb's name as its entry point has it, and the words behind it."""

    verb: str
    words: tuple[str, ...]

    @property
    def argv(self):
        return [*self.verb.split("."), *self.words]


def parsers(only=None):
    """The parsers of all registered verbs, or of those whose name begins with `only`."""
    points = sorted(entry_points(group=GROUP), key=lambda each: each.name)
    return {each.name: build_parser(each.name, load_verb(each)) for each in points if each.name.startswith(only or "")}


def flags_with_values(parser):
    """The long flags that take a value."""
    return [
        each.option_strings[-1]
        for each in parser._actions
        if each.option_strings and each.nargs != 0 and not isinstance(each, argparse.BooleanOptionalAction)
    ]


def one_value_calls(verb, parser, values=VALUES):
    """Each value in each place: `--flag=VALUE`, and instead of each positional word."""
    valid = VALID.get(verb, "").split()
    for value in values:
        for flag in flags_with_values(parser):
            yield Call(verb, (*valid, f"{flag}={value}"))
        for at, word in enumerate(valid):
            if word[0] != "-" and (at == 0 or valid[at - 1][0] != "-"):
                yield Call(verb, (*valid[:at], value, *valid[at + 1 :]))
        yield Call(verb, (*valid, value))


def random_call(verb, parser, draw: random.Random):
    """Several flags with random values, and sometimes flags without one."""
    words = list(VALID.get(verb, "").split())
    for _ in range(draw.randint(1, 3)):
        action = draw.choice([each for each in parser._actions if each.option_strings and each.dest != "help"])
        words.append(draw.choice(action.option_strings))
        if action.nargs != 0 and not isinstance(action, argparse.BooleanOptionalAction):
            choices = [str(each) for each in action.choices or ()]
            words += [draw.choice((*VALUES, *choices)) for _ in range(1 if draw.random() < 0.8 else 2)]
    return Call(verb, tuple(words))


def write_stage(folder):
    """A folder with what `VALID` and `VALUES` name."""
    folder.mkdir()
    copytree(FIXTURES / "runs", folder / "runs")
    write_drives(folder / "data", 3)
    (folder / "report.json").write_bytes(REPORT.read_bytes())
    (folder / "settings.toml").write_text('[[host]]\naddress = "nowhere.invalid"\n')
    (folder / "folder").mkdir()
    (folder / "empty").touch()
    (folder / "binary").write_bytes(bytes(range(256)) * 64)
    (folder / "other.npz").write_bytes((FIXTURES / "runs" / "dream" / "controller.npz").read_bytes()[:-900])
    authority = Authority.create(folder / "access")
    authority.issue("worker", "w", folder / "w-issued.join")
    return folder
