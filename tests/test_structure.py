"""The structure that architecture.md describes: what must not grow again."""

import ast
import re
from collections import defaultdict
from importlib import import_module
from importlib.metadata import entry_points

from deploy import structure
from deploy.structure import (
    ROOT,
    SIDES,
    WORLDS,
    class_names,
    core,
    floors,
    imports_of,
    lines,
    listed_modules,
    mirrored,
    module_of,
    names_outside_rooms,
    room_arrows,
    sources,
    starting_children,
    surface,
)
from dreamfleet.common.worlds import shipped

MOST_FILES = 20  # in a folder
MOST_LINES = 38_000  # of the core, which a newcomer must read
MOST_VERBS, MOST_FLAGS = 54, 185  # of the command line; other settings are keys of `--set` and of files
# Files that name a world outside its rooms. This list may only shrink.
NAMING_WORLDS = {
    "common/addons/worlds/__init__.py": "lists its modules",
    "common/artifacts/__init__.py": "lists car_racing_variants",
    "common/artifacts/driving.py": "the one default, and its variants",
    "common/host/packages.py": "packages and extras, as pyproject.toml names them",
    "worker/addons/health.py": "doctor asks it where gymnasium may be absent, which CarRacing's room imports",
    "worker/dream/__init__.py": "an environment's former name, which notebooks and agents of others use",
    "worker/addons/bench/environment.py": "compares our CarRacing with gymnasium's, by the episode loop above its room",
    "worker/addons/baselines/agents.py": "baselines are agents of CarRacing, trained by rooms above its",
}
# Files that start child processes and do not wait for them at once. This list may only shrink.
STARTING_CHILDREN = {
    "common/host/child.py": "the one class for it",
    "common/host/descendants.py": "its guard",
    "coordinator/addons/spawn/agent.py": "runs on a host where nothing of ours is installed",
    "worker/addons/bench/dispatch.py": "measures the standard library's pool",
}
# Modules whose test no name leads to. This list may only shrink.
WITHOUT_TEST = {
    "common/errors.py",  # exceptions alone
    # measurements, which people start
    *(f"worker/addons/bench/{name}.py" for name in ("live", "steps", "torch_steps")),
}

# What stands in a printed command as it is, without shlex or `shell_command`: names that were checked, and constants.
PLAIN_WORDS = {
    "common/addons/batches/batch_client.py": {"run"},
    "common/cli/command_line.py": {"wanted"},
    "common/client/client.py": {"again"},
    "common/client/run_view.py": {"status.run"},
    "common/host/packages.py": {"extra", "wanted"},
    "common/verbs/control.py": {"name"},
    "coordinator/addons/dashboard/page_state.py": {"look.status.run"},
    "coordinator/addons/runs/stored_run.py": {"package"},
    "coordinator/addons/runs/verb.py": {"args.kind"},
    "coordinator/addons/spawn/agent.py": {"' '.join((*FOLDERS, CREATED, LOCK))", "' '.join(map(str, found))"},
    "coordinator/addons/spawn/connection.py": {"address", "self._address"},  # quoted once
    "coordinator/addons/status/status_panel.py": {"status.run", "task_flag", "worker_flags"},  # made quoted
    "worker/addons/card/card_page.py": {"CONTROLLER", "bundle"},
    "worker/worlds/gym/environments.py": {"known[0]"},
}


def printed_words() -> dict[str, set[str]]:
    """By file, the values that an f-string puts into a command as they are."""
    verbs = {point.name.split()[0] for point in entry_points(group="dreamfleet.verbs")}
    shell = r"\b(rm|mv|cp|cd|chmod \d+|mkdir|kill|pip install|openssl)|`ssh"
    command = re.compile(rf"(\bdreamfleet ({'|'.join(verbs)})|{shell}) [^`;:()\n]*$")
    quoting = re.compile(r"(shlex\.)?(quote|join)\(|shell_command\(")
    found = defaultdict(set)
    for path in sources(*SIDES):
        for string in ast.walk(ast.parse((ROOT / path).read_text())):
            before = ""
            for part in string.values if isinstance(string, ast.JoinedStr) else ():
                if isinstance(part, ast.Constant):
                    before += part.value
                elif command.search(before) and not quoting.match(word := ast.unparse(part.value)):
                    found[str(path)].add(word)
    return found


def test_no_room_imports_a_room_above_it():
    for side in SIDES:
        assert floors(room_arrows(side))[1] == 0, side


def test_the_core_can_be_read():
    assert lines(core()) <= MOST_LINES


def test_a_public_class_name_has_one_meaning():
    assert class_names() == {}


def test_common_and_coordinator_hold_rooms_and_nothing_flat_but_what_every_room_uses():
    flat = {str(path) for side in ("common", "coordinator") for path in sources(side) if len(path.parts) == 2}
    assert flat == {"common/__init__.py", "common/errors.py", "common/printable.py", "coordinator/__init__.py"}


def test_a_room_lists_what_others_use_of_it():
    modules = {module_of(path).removesuffix(".__init__"): path for path in sources(*SIDES)}
    used = defaultdict(set)
    for module, path in modules.items():
        for name in imports_of(path):
            room, _, last = name.rpartition(".")
            if name in modules and modules[name].name != "__init__.py" and not f"{module}.".startswith(f"{room}."):
                used[room].add(last)
    for room, names in used.items():
        assert names <= set(import_module(f"dreamfleet.{room}").__all__), f"{room} has __all__ in reading order"


def test_a_folder_is_read_at_a_glance():
    counts: dict[str, int] = {}
    for path in sources(*SIDES):
        counts[str(path.parent)] = counts.get(str(path.parent), 0) + (path.name != "__init__.py")
    assert max(counts.values()) <= MOST_FILES, counts


def test_the_command_line_does_not_grow_again():
    found = surface()
    assert found["verbs"] <= MOST_VERBS
    assert found["distinct_flags"] <= MOST_FLAGS


def test_one_class_supervises_child_processes():
    assert starting_children() == STARTING_CHILDREN.keys()


def test_each_path_in_a_printed_command_is_quoted():
    assert printed_words() == PLAIN_WORDS, "use shell_command, run_command or shlex: a path may hold spaces"


def test_each_contract_is_named_for_a_file_that_it_binds():
    contracts = structure.CONFIG["tool"]["importlinter"]["contracts"]
    said = {each for path in sources(*SIDES) for each in structure.rules_of(f"dreamfleet.{module_of(path)}", set())}
    named = {each["name"] for each in contracts if any(line.startswith(each["name"]) for line in said)}
    assert named == {each["name"] for each in contracts if each["type"] != "layers"}


def test_each_command_about_a_stored_run_names_the_folder_of_runs():
    for path in sources(*SIDES):
        for call in ast.walk(ast.parse((ROOT / path).read_text())):
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "shell_command":
                words = {each.value for each in call.args if isinstance(each, ast.Constant)}
                assert not words & {"--resume", "--from", "runs", "verify", "story"} or "--runs-dir" in words, path


def test_no_world_is_named_outside_its_room():
    named = names_outside_rooms()
    assert named - NAMING_WORLDS.keys() == set(), "name it in its room, or ask the task or common/worlds for the fact"
    assert NAMING_WORLDS.keys() - named == set(), "no longer needed"
    for world in shipped.WORLDS:
        assert any(name.search(world) for name in WORLDS), f"{world} has no rooms in deploy/structure.py"


def test_a_test_of_each_module_has_its_name_or_lists_it():
    modules = {str(path) for path in sources(*SIDES) if path.name != "__init__.py"}
    tests = [path for path in sources("tests") if path.name.startswith("test_")]
    named = {mirrored(path.with_name(path.name.removeprefix("test_"))) for path in tests}
    listed = set().union(*(listed_modules(path) for path in tests))
    assert listed - modules == set(), "a docstring of a test lists what is not there"
    missing = modules - named - listed
    assert missing - WITHOUT_TEST == set(), 'name its test like it, or list it behind "Tests" in a docstring'
    assert WITHOUT_TEST - missing == set(), "no longer needed"


def test_no_test_module_imports_another():
    imports = re.compile(r"^ *from tests\.?[\w.]*(\.test_\w+ import| import .*\btest_)", re.MULTILINE)
    importing = [str(path) for path in sources("tests") if imports.search((ROOT / path).read_text())]
    assert importing == [], "what tests share lies in tests/support"


def test_pages_that_docstrings_name_are_there():
    named = set().union(*map(structure.pages_of, sources(*SIDES)))
    assert {page for page in named if not (ROOT / page).exists()} == set()


def test_the_flags_of_a_file_include_those_that_a_run_freezes():
    found = structure.flags_of((ROOT / "coordinator/settings/config.py").read_text())
    assert {"--subspace", "--driven"} <= found
