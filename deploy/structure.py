"""Measure the structure of the code: rooms, floors, imports between rooms, folder sizes, class names, wording.

`make structure` prints the figures; `tests/test_structure.py` holds those that must not grow. With `FILE=PATH` it says
what a change of that file may touch.
"""

from __future__ import annotations

import ast
import io
import json
import re
import sys
import tokenize
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
CONFIG = tomllib.loads((ROOT / "pyproject.toml").read_text())
SIDES = ("common", "coordinator", "worker", "dreamfleet/experiments")  # and the floor above both
# Words that a reader has to read twice; `style` in CONTRIBUTING.md says what to write instead.
RIDDLES = re.compile(r"\b(tell|tells|telling|told|untold|whoever|whomever)\b|\b(?:is|are|was|were|be|been) had\b")
LONG_FILE = 400
PAGE = r"\bdocs/[\w/-]+\.md\b"  # as code names it
FEW = 4  # verbs that reach a file, pages that name a flag: as many are listed
MANY = 4  # words of a text that a page would not have by chance
CALLS = r"""(?:[\[(]|dreamfleet["'],?|yield)\s*"""  # before the verb that code calls
GENERIC = ("run", "configure", "load", "option")  # functions of many files
# The worlds that ship: what names each of them, and its rooms, the files and folders in which that may stand.
WORLDS = {
    re.compile("car.?racing", re.IGNORECASE): (
        "worker/worlds/car_racing", "common/addons/worlds/car_racing.py", "common/artifacts/car_racing_variants.py",
    ),
    re.compile("take.?cover|doom", re.IGNORECASE): ("worker/worlds/takecover", "common/addons/worlds/takecover.py"),
}  # fmt: skip


def sources(*folders: str) -> list[Path]:
    """The Python files below these folders of the repository, as paths relative to it."""
    found = (path for folder in folders for path in (ROOT / folder).rglob("*.py"))
    return sorted(path.relative_to(ROOT) for path in found)


def core() -> list[Path]:
    """The files of the core: without add-ons, experiments, and the worlds that ship."""
    beside = ("common/addons", "coordinator/addons", "worker/addons", "worker/worlds")
    paths = sources("common", "coordinator", "worker")
    return [path for path in paths if not any(path.is_relative_to(room) for room in beside)]


def lines(paths: list[Path]) -> int:
    """How many lines these files have."""
    return sum(len((ROOT / path).read_text().splitlines()) for path in paths)


def module_of(path: Path) -> str:
    """The dotted name of a file's module, without `dreamfleet.`."""
    return ".".join(path.with_suffix("").parts).removeprefix("dreamfleet.")


def room_of(module: str) -> str:
    """The room of a module: the first part of its name below its side; a flat module is a room by itself."""
    return module.split(".")[1] if "." in module else ""


def imports_of(path: Path) -> Iterator[str]:
    """The modules of this project that a file imports, at its top or in a function, without `dreamfleet.`."""
    for node in ast.walk(ast.parse((ROOT / path).read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("dreamfleet."):
            module = node.module.removeprefix("dreamfleet.")
            yield from (f"{module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (each.name.removeprefix("dreamfleet.") for each in node.names if "dreamfleet." in each.name)


def room_arrows(side: str) -> dict[str, set[str]]:
    """Which rooms of a side each of its rooms imports."""
    arrows: dict[str, set[str]] = defaultdict(set)
    name = side.removeprefix("dreamfleet/")
    for path in sources(side):
        own = room_of(module_of(path))
        if own == "__init__":
            continue
        others = {room_of(module) for module in imports_of(path) if module.startswith(f"{name}.")}
        arrows[own] |= others - {own, "", "__init__"}
    return dict(arrows)


def floors(arrows: dict[str, set[str]]) -> tuple[list[list[str]], int]:
    """The rooms by floor, the lowest first, and how many arrows close a cycle, so that no floor can hold them."""
    left, built, upward = dict(arrows), [], 0
    while left:
        ready = sorted(room for room, others in left.items() if not others & left.keys())
        if not ready:  # the room with the fewest arrows into the rest goes first, against those arrows
            ready = [min(sorted(left), key=lambda room: len(left[room] & left.keys()))]
            upward += len(left[ready[0]] & left.keys())
        built.append(ready)
        for room in ready:
            del left[room]
    return built, upward


def class_names() -> dict[str, list[str]]:
    """Every public class name that more than one module defines, with those modules."""
    homes: dict[str, list[str]] = defaultdict(list)
    for path in sources(*SIDES):
        for node in ast.parse((ROOT / path).read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(str(path))
    return {name: paths for name, paths in homes.items() if len(paths) > 1}


def riddles(path: Path) -> list[tuple[int, str]]:
    """Lines of a Python file whose names, comments or docstrings hold a word of `RIDDLES`."""
    text, found = (ROOT / path).read_text(), []
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        words = token.string.replace("_", " ") if token.type == tokenize.NAME else token.string
        plain = token.type in (tokenize.NAME, tokenize.COMMENT, tokenize.STRING)
        if plain and RIDDLES.search(words):
            found += [(token.start[0], match.group()) for match in RIDDLES.finditer(words)]
    return found


def starting_children() -> set[str]:
    """The files that start child processes and do not wait for them at once."""
    starts = re.compile(r"\bPopen\(|(?<!psutil)\.(Process|Pool)\(|ProcessPoolExecutor\(|\bos\.fork\(")
    return {str(path) for path in sources(*SIDES) if starts.search((ROOT / path).read_text())}


def words_of(path: Path) -> Iterator[str]:
    """The names and the texts in a Python file's code: no comments, and no texts that stand alone, as docstrings do."""
    tree = ast.parse((ROOT / path).read_text())
    alone = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if node not in alone:
            yield from (value for _, value in ast.iter_fields(node) if isinstance(value, str))


def names_outside_rooms() -> set[str]:
    """The files that name a world outside its rooms."""
    found = set()
    for path in sources(*SIDES):
        foreign = [name for name, rooms in WORLDS.items() if not any(path.is_relative_to(room) for room in rooms)]
        if any(name.search(word) for word in (str(path), *words_of(path)) for name in foreign):
            found.add(str(path))
    return found


def surface() -> dict[str, int]:
    """How large the command line is: verbs, distinct long flags, the most of one verb, lines of the longest help texts.

    It needs an environment in which dreamfleet is installed.
    """
    from importlib.metadata import entry_points

    from dreamfleet.common.cli.command_line import DESCRIPTION, EXIT_CODES, GROUP, build_parser, load_verb
    from dreamfleet.common.cli.overview import overview

    points = {each.name: each for each in entry_points(group=GROUP)}
    parsers = [build_parser(name, load_verb(point)) for name, point in points.items()]
    flags = [{flag for flag in each._option_string_actions if flag.startswith("--")} for each in parsers]
    return {
        "verbs": len(points),
        "distinct_flags": len({flag for each in flags for flag in each if not flag.startswith("--no-")}),
        "most_flags_of_a_verb": max(map(len, flags)),
        "lines_of_help": overview(DESCRIPTION, EXIT_CODES, points, str).count("\n"),
        "most_lines_of_a_verbs_help": max(each.format_help().count("\n") for each in parsers),
    }


def measure() -> dict[str, object]:
    """All figures, as `--json` prints them."""
    figures: dict[str, object] = {}
    for side in SIDES:
        arrows = room_arrows(side)
        layers, upward = floors(arrows)
        figures[side] = {
            "rooms": len(arrows),
            "floors": len(layers),
            "arrows": sum(len(others) for others in arrows.values()),
            "upward": upward,
            "files": len(sources(side)),
            "lines": lines(sources(side)),
            "layers": layers[::-1],
        }
    figures["core_lines"] = lines(core())
    folders = Counter(str(path.parent) for path in sources(*SIDES) if path.name != "__init__.py")
    lengths = {str(path): (ROOT / path).read_text().count("\n") for path in sources(*SIDES)}
    figures["most_files_in_a_folder"] = folders.most_common(1)[0]
    figures["files_under_40_lines"] = sum(2 < length < 40 for length in lengths.values())
    figures["files_over_400_lines"] = {path: length for path, length in lengths.items() if length > LONG_FILE}
    figures["duplicate_class_names"] = class_names()
    figures["files_that_start_children"] = sorted(starting_children())
    with suppress(ImportError):
        figures["command_line"] = surface()
    figures["riddles"] = {part: sum(len(riddles(path)) for path in sources(part)) for part in (*SIDES, "tests")}
    return figures


@cache
def listed_modules(test: Path) -> set[str]:
    """The files that a test's docstring lists behind "Tests": with their folders, or of the folder that it mirrors."""
    docstring = re.match(r'"""(.*?)"""', (ROOT / test).read_text(), re.DOTALL)
    names = re.findall(r"[\w/]+\.py\b", docstring[1].partition("Tests ")[2]) if docstring else []
    return {name if "/" in name else mirrored(test.with_name(name)) for name in names}


def tests_of(path: Path) -> list[Path]:
    """The tests of a product file: the one that mirrors it, and those that list it."""
    mirror = Path(f"tests/{path.parent}/test_{path.name}".replace("dreamfleet/", ""))
    return [each for each in sources("tests") if each == mirror or str(path) in listed_modules(each)]


def mirrored(test: Path) -> str:
    """The path that a file of the tests mirrors: `tests/experiments` stands for `dreamfleet/experiments`."""
    path = str(test.relative_to("tests"))
    return f"dreamfleet/{path}" if path.startswith("experiments/") else path


def is_in(module: str, package: str) -> bool:
    """Whether a module is this package or lies in it (both dotted)."""
    return f"{module}.".startswith(f"{package}.")


def rules_of(module: str, users: set[str]) -> Iterator[str]:
    """What the import contracts say of a module (dotted, with `dreamfleet.`), also through the modules that use it."""
    for contract in CONFIG["tool"]["importlinter"]["contracts"]:
        sources, layers = contract.get("source_modules", []), contract.get("layers", [])
        for container in contract.get("containers", [""]):
            rooms = [[f"{container}.{room}".lstrip(".") for room in layer.split(" | ")] for layer in layers]
            for number, floor in enumerate(rooms):
                for own_room in (room for room in floor if is_in(module, room)):
                    below = [room for layer in rooms[number + 1 :] for room in layer]
                    text = f"of {container or 'dreamfleet'} it may import {', '.join([own_room, *below])}, and no other"
                    yield text.replace("dreamfleet.", "")
        own = any(is_in(module, each) for each in sources)
        through = sorted({each for each in users for source in sources if is_in(each, source)})
        alike = contract.get("modules", [])
        if own or through or any(is_in(module, each) for each in alike):
            others = [each.removeprefix("dreamfleet.") for each in alike if not is_in(module, each)]
            forbidden = ", ".join([*contract.get("forbidden_modules", []), *others])
            by = "" if own or not through else f", as {through[0].removeprefix('dreamfleet.')} uses it"
            yield f"{contract['name']}{by}{f': not {forbidden}' if forbidden else ''}"


def users_of(module: str, imported: dict[Path, set[str]]) -> set[str]:
    """All modules that import this one, also through others (dotted, with `dreamfleet.`)."""
    found, new = set(), {module}
    while new:
        found |= new
        new = {
            f"dreamfleet.{module_of(path)}"
            for path, names in imported.items()
            if path.parts[0] != "tests" and any(is_in(f"dreamfleet.{name}", each) for name in names for each in new)
        } - found
    return found - {module}


def names_taken(path: Path, module: str) -> list[str]:
    """What a file imports from a module (dotted, with `dreamfleet.`)."""
    tree = ast.walk(ast.parse((ROOT / path).read_text()))
    found = (node.names for node in tree if isinstance(node, ast.ImportFrom) and node.module == module)
    return sorted({alias.name for names in found for alias in names})


def subclasses(names: set[str], users: list[Path]) -> Iterator[str]:
    """The classes in these files that extend one of these names."""
    for path in users:
        for node in ast.walk(ast.parse((ROOT / path).read_text())):
            for base in {ast.unparse(each).rpartition(".")[2] for each in getattr(node, "bases", [])} & names:
                yield f"{path}: {node.name}({base})"  # type: ignore[attr-defined]


def pages_of(path: Path) -> set[str]:
    """The pages that a file names: those behind "Pages:" in its docstring without their folder, and others with it."""
    text = (ROOT / path).read_text()
    listed = re.findall(r"[\w-]+\.md\b", (ast.get_docstring(ast.parse(text)) or "").partition("Pages:")[2])
    by_name = {page.name: str(page.relative_to(ROOT)) for page in (ROOT / "docs").rglob("*.md")}
    return {*re.findall(PAGE, text), *(by_name.get(name, name) for name in listed)}


def flags_of(text: str) -> set[str]:
    """The flags that a file adds: those of `add_argument`, and of fields that are an `option`."""
    fields = re.findall(r"^    (\w+): [^=\n]+= (?:frozen_)?option\(", text, re.MULTILINE)
    return {*re.findall(r'add_argument\(\s*"(--[\w-]+)"', text), *(f"--{name.replace('_', '-')}" for name in fields)}


def texts(*patterns: str) -> dict[str, str]:
    """The files of the repository that match, by path; what is made by another program is left out."""
    paths = (path for pattern in patterns for path in sorted(ROOT.glob(pattern)))
    made = (".pyc", ".lock")
    return {
        str(each.relative_to(ROOT)): each.read_text() for each in paths if each.is_file() and each.suffix not in made
    }


def about(path: Path) -> dict[str, list[str]]:
    """What a change of a file (a path in the repository) may touch: its room, rules, importers, tests and documents."""
    if path not in sources(*SIDES):
        raise SystemExit(f"no Python file of {', '.join(SIDES)}: {path}")
    module, text, room = f"dreamfleet.{module_of(path)}", (ROOT / path).read_text(), path.parent / "__init__.py"
    imported = {each: set(imports_of(each)) for each in sources(*SIDES, "tests")}
    users = [each for each, names in imported.items() if any(is_in(f"dreamfleet.{name}", module) for name in names)]
    file = str(path) if sum(each.name == path.name for each in imported) > 1 else path.name
    public = [each.name for each in ast.parse(text).body if isinstance(each, (ast.ClassDef, ast.FunctionDef))]
    named = rf"\b({re.escape(file)}|{re.escape(module)})\b"
    groups = dict(CONFIG["project"]["entry-points"])
    verbs = {name.replace(".", " "): value.partition(":")[0] for name, value in groups.pop("dreamfleet.verbs").items()}
    through = users_of(module, imported)
    reached = {module, *through}
    near = sorted(verb for verb, of in verbs.items() if of in reached)
    own_verbs = [verb.split() for verb, of in verbs.items() if of == module]
    between = r"""["', ]+"""
    calls = [rf"""{CALLS}["']{between.join(verb)}["']""" for verb in own_verbs]
    written = [f"dreamfleet {' '.join(verb)}\\b" for verb in own_verbs]
    codes = [f"`{each}\\b" for each in public if not each.startswith("_") and each not in GENERIC]
    worlds = [
        f"(?i:{name.pattern})" for name, rooms in WORLDS.items() if any(path.is_relative_to(room) for room in rooms)
    ]
    rooms = [each / "__init__.py" for each in path.parents if (ROOT / each / "__init__.py").exists()]
    around = set().union(*map(pages_of, rooms))
    in_code = re.compile("|".join([named, *calls, *written]))
    in_pages = re.compile("|".join([named, *written, *codes]))
    of_world = re.compile("|".join(worlds) or "(?!)")
    own = tests_of(path)
    naming = {each for each in sources("tests") if in_code.search((ROOT / each).read_text())}
    product = [each for each in users if each.parts[0] != "tests"]
    tests = [*own, *sorted({*users, *naming} - {*own, *product})]  # those of its own first
    run = [rf"""{CALLS}["']{between.join(verb.split())}["']""" for verb in near]
    by_verb = re.compile("|".join(run if len(run) <= FEW else ()) or "(?!)")
    running = {each for each in sources("tests") if by_verb.search((ROOT / each).read_text())}
    outside = [each for each in product if each.parent != path.parent]
    if f'"{path.stem}"' in (ROOT / room).read_text():
        listed = "the room lists it for others"
    else:
        listed = "the room's own" + (": no other room imports it" if not outside else ", and imported from elsewhere")
    kind = "core" if path in core() else "an add-on" if "addons" in path.parts else "neither core nor add-on"
    documents = texts("README.md", "CONTRIBUTING.md", "docs/**/*.md", ".github/**/*")
    scripts = texts("Makefile", ".ci/run", "deploy/**/*", "docs/**/*.py")
    points = [
        f"{each}: {name}"
        for each, of in groups.items()
        for name, value in of.items()
        if value.partition(":")[0] in reached
    ]
    code = texts(*(f"{side}/**/*.{ending}" for side in SIDES for ending in ("py", "js", "c")))
    said = {" ".join(each.split()) for each in words_of(path) if len(each.split()) >= MANY}
    flat = {name: " ".join(page.split()) for name, page in documents.items()}
    quoted = {name for name, page in flat.items() if any(map(page.__contains__, said))}
    for flag in flags_of(text):
        found = {name for name, page in flat.items() if re.search(rf"(?<![\w-]){flag}(?![\w-])", page)}
        quoted |= found if len(found) <= FEW else set()
    close = {name for name, page in documents.items() if name in {*pages_of(path), *quoted} or in_pages.search(page)}
    return {
        str(path): [ast.get_docstring(ast.parse(text)) or ""],
        str(path.parent): [ast.get_docstring(ast.parse((ROOT / room).read_text())) or "", listed, kind],
        "bound by": list(rules_of(module, through)),
        "imported by": [f"{each} ({', '.join(names_taken(each, module)) or 'the module'})" for each in product],
        "extended by": list(subclasses(set(public), users)),
        "tests": list(map(str, tests)) or ["none"],
        "those of its importers": sorted(
            {str(test) for each in product for test in tests_of(each)} - {*map(str, tests)}
        ),
        "and those of its verbs": sorted(map(str, running - {*tests})) if len(near) <= FEW else ["too many verbs"],
        "reached by the entry points": points,
        "and by the verbs (docs/reference/verbs.md)": [", ".join(near) if len(near) <= 12 else "most of them"],
        "named in the code of": sorted(
            name for name, each in code.items() if re.search(named, each) and Path(name) not in {path, *users}
        ),
        "named in": [*sorted(close), *(name for name, script in scripts.items() if in_code.search(script))],
        "and pages of its room or world": sorted(
            name for name, page in documents.items() if name not in close and (name in around or of_world.search(page))
        ),
    }


def main() -> None:
    """Print the figures, or what is known of the file that is named; with `--json` as one document."""
    named = [each for each in sys.argv[1:] if not each.startswith("-")]
    figures: dict[str, Any] = about(Path(named[0])) if named else measure()
    if "--json" in sys.argv[1:]:
        print(json.dumps(figures, indent=1))
        return
    for name, value in figures.items():
        print(f"{name}:")
        parts = value.items() if isinstance(value, dict) else [(each,) for each in value] if named else [("", value)]
        for each in parts:
            print("  " + " ".join(str(part) for part in each).strip().replace("\n", "\n  "))


if __name__ == "__main__":
    main()
