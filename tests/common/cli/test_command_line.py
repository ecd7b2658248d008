"""The command line: finding and loading verbs, help, and errors for typing mistakes.
Tests key_values.py, overview.py, parser.py, presets.py and common/host/standard_streams.py."""

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from functools import partial
from importlib.metadata import EntryPoint, entry_points, version
from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.cli import command_line
from dreamfleet.common.cli.command_line import build_parser
from dreamfleet.common.cli.overview import GROUPS, WIDTH
from dreamfleet.common.cli.presets import NAMES, check_preset
from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.host import packages
from dreamfleet.common.host.standard_streams import LAST_STREAM
from dreamfleet.coordinator.settings import presets as runs
from dreamfleet.coordinator.settings.stage_tables import split_first_stage
from dreamfleet.coordinator.verbs import coordinator
from dreamfleet.worker.addons.baselines import presets as baselines
from dreamfleet.worker.addons.baselines import verb as baseline
from dreamfleet.worker.training import presets
from dreamfleet.worker.verbs import train
from tests.fuzz.calls import flags_with_values
from tests.support.journals import RUNS
from tests.support.processes import DEADLINE, ROOT

BROKEN = EntryPoint("broken", "tests.no_such_module", command_line.GROUP)


def points(*more):
    return {point.name: point for point in (*entry_points(group=command_line.GROUP), *more)}


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("coordinator --populaton 8", "--populaton 8 --population"),
        ("coordinator --evaluate-evry=3", "--evaluate-every"),
        ("record --controler real", "--controler --controller"),
        ("coordinator --popsize 8", "--popsize 8 --population"),
        ("runs export dream --csv out.csv", "--csv 'out.csv'"),
        ("coordinator --gen 3", "--gen 3 --generations"),
        ("coordinator --r x", "--run --resume --runs-dir --racing --recorded"),
        ("coordinator -- --run x", "--run"),
        ("train --dat d vae", "--dat --data"),
        ("iterate --rounds x --run-flags '--gener 1'", "--rounds 'x'"),
        ("evaluate --tracks 3", "--tracks --episodes"),
        ("evaluate real", "'real' --controller real"),
        ("status --xyzzy", "--xyzzy dreamfleet status"),
        ("runs list --runs-dir ''", "--runs-dir"),
        ("wokrer", "'wokrer' 'worker'"),
        ("runs lits", "'runs lits' 'runs list'"),
        ("run", "'run' 'coordinator'"),
        ("help", "'help' '--help'"),
        ("run list", "'run' 'runs list'"),
        ("receipt night", "'receipt' 'runs receipt'"),
        ("export", "'export' 'baseline export' 'runs export'"),
        ("xyzzy", "'xyzzy' `dreamfleet --help`"),
    ],
)
def test_the_error_for_an_unknown_flag_or_verb_suggests_the_nearest(words, named, capsys):
    """`named`: what it names, in this order."""
    assert command_line.main(shlex.split(words)) == UsageError.exit_code
    error = capsys.readouterr().err
    assert re.search(named.replace(" ", ".*"), error)
    assert error.count("\n") == 1


@pytest.mark.parametrize("words", ["--help", "runs --help", "worker --help", "train vae --help", "", "runs"])
def test_help_lists_the_exit_codes_and_a_missing_verb_names_it(words, capsys):
    with pytest.raises(SystemExit) as left:
        command_line.main(words.split())
    is_help = words.endswith("--help")
    assert left.value.code == (0 if is_help else UsageError.exit_code)
    assert ("130" if is_help else "--help") in "".join(capsys.readouterr())


def test_the_version_is_that_of_the_installed_package(capsys):
    with pytest.raises(SystemExit):
        command_line.main(["--version"])
    assert capsys.readouterr().out.split() == ["dreamfleet", version("dreamfleet")]


def test_a_broken_verb_does_not_affect_others(capsys, tmp_path):
    assert command_line.run_verb(points(BROKEN), ["runs", "list", "--runs-dir", str(tmp_path)]) == 0
    with pytest.raises(SystemExit):
        command_line.run_verb(points(BROKEN), ["--help"])
    output = " ".join(capsys.readouterr().out.split())
    assert re.search(r"broken +BROKEN: .*tests\.no_such_module", output)
    assert "worker" in output
    with pytest.raises(DreamfleetError, match=r"'broken' .*ModuleNotFoundError"):
        command_line.run_verb(points(BROKEN), ["broken"])


def test_closed_streams_are_replaced(tmp_path):
    program = (
        "import os, sys; from dreamfleet.common.cli.command_line import main; assert sys.stdout is None; "
        "main(['runs', 'list']); raise SystemExit(os.open('journal', os.O_CREAT | os.O_WRONLY))"
    )
    command = ["bash", "-c", '"$@" <&- >&- 2>&-', "-", sys.executable, "-c", program]
    number = subprocess.run(command, cwd=tmp_path, check=False, timeout=DEADLINE).returncode
    assert number > LAST_STREAM


def test_a_missing_folder_of_runs_is_an_error_where_it_was_named_and_a_lack_of_memory_anywhere(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert command_line.main(["runs", "list"]) == 0
    for place in (tmp_path / "missing", Path("/dev/null")):
        assert command_line.main(["runs", "list", "--runs-dir", str(place)]) == UsageError.exit_code
        assert f"--runs-dir {place}" in capsys.readouterr().err
    monkeypatch.setattr(command_line, "run_verb", lambda *_: np.zeros(2**50))
    assert command_line.main(["tasks"]) == 1
    assert re.fullmatch(r".*\(Unable to allocate .*\).*\n", capsys.readouterr().err)


@pytest.mark.parametrize("name", ["x" * 5000, "\udcff\udc80", "a\nb\x1b[2J", "a\0b"])
def test_an_impossible_name_is_one_short_printable_line(name, tmp_path, capsys):
    of_names = ("runs show", "coordinator --run", "worker --name", "", "runs", "coordinator --run r --task")
    for words in ([*each.split(), name] for each in of_names):
        folder = ["--runs-dir", str(tmp_path)] if "--task" in words else []
        assert command_line.main([*words, *folder]) in (DreamfleetError.exit_code, UsageError.exit_code)
        said = capsys.readouterr().err
        assert said.removesuffix("\n").isprintable()
        assert len(said) < 1500


def run_program(*words, out=subprocess.PIPE, err=subprocess.PIPE, before=(), **environment):
    command = [*before, sys.executable, "-P", "-m", "dreamfleet", *map(str, words)]
    return subprocess.run(command, stdout=out, stderr=err, env=os.environ | environment, check=False, timeout=DEADLINE)


def test_a_stream_of_ascii_takes_every_text():
    ascii_only = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = run_program("runs", "show", "dream", "--runs-dir", RUNS, **ascii_only)
    assert (done.returncode, done.stderr) == (0, b"")
    assert rb"\xb1" in done.stdout


def test_a_full_disk_under_stderr_ends_no_verb(tmp_path):
    with Path("/dev/full").open("wb") as full:
        done = run_program("runs", "list", "--runs-dir", tmp_path, err=full)
        assert done.returncode == 0
        done = run_program("runs", "show", "dream", "--runs-dir", RUNS, out=full)
    assert (done.returncode, done.stderr.count(b"\n")) == (1, 1)


def test_a_deleted_current_folder_is_one_line(tmp_path):
    in_a_deleted_folder = ("sh", "-c", f'mkdir {tmp_path}/x; cd {tmp_path}/x; rmdir ../x; exec "$@"', "-")
    done = run_program("doctor", before=in_a_deleted_folder)
    assert (done.returncode, done.stderr.count(b"\n")) == (UsageError.exit_code, 1)


INTERRUPTED_AT_AN_IMPORT = """
import os, signal, sys
class Finder:
    left = int(sys.argv.pop(1))
    def find_spec(self, *_):
        Finder.left -= 1
        if not Finder.left:
            os.kill(os.getpid(), signal.SIGINT)
from dreamfleet.__main__ import main
sys.meta_path.insert(0, Finder())
sys.exit(main())
"""


@pytest.mark.parametrize("number", [1, 40, 120, 240])
def test_ctrl_c_amid_an_import_leaves_no_traceback(number):
    command = [sys.executable, "-c", INTERRUPTED_AT_AN_IMPORT, str(number), "runs", "show", "dream", "--runs-dir", RUNS]
    done = subprocess.run(command, capture_output=True, check=False, timeout=DEADLINE)
    assert done.stderr.count(b"\n") <= 1
    assert done.returncode in (0, -signal.SIGINT, command_line.EXIT_INTERRUPTED)  # a shell says 130 of both


def turn_into_another_error(_args):
    """As the import of a class does."""
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt as error:
        raise RuntimeError("Error calling __set_name__") from error


def interrupt_in_a_finaliser(_args):
    class Finalised:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    item = Finalised()
    del item
    time.sleep(DEADLINE)
    raise AssertionError("it slept on")


@pytest.mark.parametrize("run", [turn_into_another_error, interrupt_in_a_finaliser])
def test_ctrl_c_that_user_code_swallows_is_not_lost(run, monkeypatch, capsys):
    monkeypatch.setattr(command_line, "load_verb", lambda _: command_line.SimpleVerb("odd", lambda parser: None, run))
    before = signal.getsignal(signal.SIGINT)
    assert command_line.main(["tasks"]) == command_line.EXIT_INTERRUPTED
    assert capsys.readouterr().err.count("\n") == 1
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize(
    ("words", "package", "extras"),
    [
        (["demo"], "av", "worker,views"),
        (["demo", "--world", "takecover"], "vizdoom", "worker,views,doom"),
        (["pipeline", "--data", "data"], "torch", "train"),
    ],
)
def test_a_missing_package_is_said_first_with_the_verbs_extras_and_its_own(
    words, package, extras, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(packages, "find_spec", lambda name: None if name == package else 1)
    assert command_line.main(words) == 1
    assert re.search(f"{package!r}.*{extras}", capsys.readouterr().err)
    assert not list(tmp_path.iterdir())


SILENT = ("completion", "dashboard", "demo", "router", "serve", "worker")  # for a person who watches, or for nobody


@pytest.mark.parametrize("name", sorted(points()))
def test_help_shows_the_first_flags_and_help_all_the_rest(name):
    verb = points()[name].load()
    parser = command_line.build_parser(name, verb)
    short, whole = parser.format_help(), parser.format_all_help()
    known = {flag for flag in parser._option_string_actions if flag.startswith("--")}
    assert {"--config", "--log-level", *getattr(verb, "FIRST", "").split()} <= known
    assert name in SILENT or "--json" in known
    assert known.isdisjoint(getattr(verb, "ELSEWHERE", {}))
    assert len(short.splitlines()) <= 75
    assert f"`{parser.prog} --help-all` shows " in short
    assert all(flag in whole for flag in known if not flag.startswith("--no-"))
    for flag in flags_with_values(parser):
        with pytest.raises(UsageError, match=flag):
            parser.parse_all([f"{flag}=--"])


def test_the_overview_fits_a_terminal_and_loads_no_verb(capsys, monkeypatch):
    monkeypatch.setattr(command_line, "load_verb", lambda point: pytest.fail(f"{point.name} was loaded"))
    with pytest.raises(SystemExit) as left:
        command_line.main(["--help"])
    lines = capsys.readouterr().out.splitlines()
    assert left.value.code == 0
    assert max(map(len, lines[: lines.index("Documents")])) <= WIDTH
    assert len(lines) <= 75
    assert Path(lines[-1].strip()).read_text().startswith("# ")  # the documents are in the wheel
    assert sorted(name for entries in GROUPS.values() for names in entries for name in names) == sorted(points())
    assert {*command_line.OTHER_NAMES.values()} <= {*points(), "--help"}


def test_the_names_match_the_presets_of_each_side_and_an_error_names_the_other_kind():
    assert set(NAMES["run"]) == set(runs.PRESETS)
    assert set(NAMES["training"]) == set(presets.PRESETS)
    assert set(NAMES["baseline"]) == set(baselines.PRESETS)
    for find, name, kind in (
        (partial(check_preset, "run"), "attentive", "training"),
        (presets.find_preset, "dream", "run"),
        (partial(check_preset, "baseline"), "tiny", "training"),
    ):
        with pytest.raises(UsageError, match=kind):
            find(name)


def test_help_lists_each_presets_values():
    training, learning = build_parser("train", train), build_parser("baseline.train", baseline.TRAIN)
    help_text = " ".join(training.format_all_help().split())
    assert "(default 0; pixels, takecover 1.0)" in help_text
    assert "(default 0; attentive, paper 10)" in help_text
    assert "(notebook 5,5,6,6)" in help_text
    assert "(default 16; notebook 64)" in " ".join(learning.format_all_help().split())


def test_docs_have_a_row_for_each_training_preset():
    page = (ROOT / "docs" / "reference" / "presets.md").read_text().partition("## Presets of trainings")[2]
    assert sorted(re.findall(r"^\| `([\w-]+)`", page, re.MULTILINE)) == sorted(NAMES["training"])


def test_docs_list_each_run_presets_values():
    page = (ROOT / "docs" / "reference" / "presets.md").read_text()
    described = dict(re.findall(r"^\| `([\w-]+)` \| `(--[^`]+)`", page, re.MULTILINE))
    assert described.keys() == runs.PRESETS.keys()
    for name, flags in described.items():
        named, _ = split_first_stage(runs.PRESETS[name].get("stages", ()))
        assert not named, "it would hide the flag of that name"
        said = vars(build_parser("coordinator", coordinator).parse_all(shlex.split(flags)))
        settings = {key: value for key, value in runs.PRESETS[name].items() if key not in ("stages", "preset_variant")}
        if variant := runs.PRESETS[name].get("preset_variant"):
            settings["variant"] = variant
        heard = {key: tuple(said[key]) if isinstance(said[key], list) else said[key] for key in settings}
        assert heard == settings
        assert flags.count("--") == len(settings)
