"""Write docs/reference/verbs.md and settings.md from the parsers and the settings' dataclasses, and types of settings.

`make reference` writes them; `tests/docs/test_reference.py` compares them with what this would write. Help texts are
the source: to change a row, change the verb.
"""

from __future__ import annotations

import argparse
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import MISSING, Field, fields
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from keyword import iskeyword
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from dreamfleet.common.addons.router.verb import RouterConfig
from dreamfleet.common.cli.command_line import GROUP, build_parser, load_verb
from dreamfleet.common.cli.global_config import GlobalConfig
from dreamfleet.coordinator.addons.bridge.verb import BridgeConfig
from dreamfleet.coordinator.addons.dashboard.config import DashboardConfig
from dreamfleet.coordinator.addons.spawn.config import SpawnConfig
from dreamfleet.coordinator.settings import run_setup
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.experiments.demo import DemoConfig
from dreamfleet.experiments.iteration.config import IterateConfig
from dreamfleet.experiments.started_run import setting_names
from dreamfleet.worker.addons.baselines.presets import AgentConfig, LearningConfig
from dreamfleet.worker.service.config import WorkerConfig
from dreamfleet.worker.training.presets import TrainConfig
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig

FOLDER = Path(__file__).parents[1] / "docs" / "reference"
NOTE = "<!-- Written by `make reference`: change the help text in the code, not this page. -->"
# Table of the configuration file: its dataclass, and what it is of. The empty name is the top of the file.
# Several dataclasses in one table are of the trainings, whose keys are those of `--set` rather than flags.
SECTIONS: Mapping[str, tuple[type | tuple[type, ...], str]] = {
    "": (
        GlobalConfig,
        "What every program of a fleet shares. These keys stand at the top of the file, before any table.",
    ),
    "run": (
        RunConfig,
        "What is frozen with a new run. `dreamfleet coordinator --from RUN` begins another run with other values.",
    ),
    "limits": (LimitsConfig, "When a run ends: at the first limit that it reaches. 0 means no such limit."),
    "network": (NetworkConfig, "Where the coordinator is reached, and how it treats its workers. Kept with the run."),
    "worker": (WorkerConfig, "A worker process."),
    "dashboard": (DashboardConfig, "The web page."),
    "serve": (BridgeConfig, "`dreamfleet serve`: batches over HTTP."),
    "router": (RouterConfig, "A router of its own."),
    "spawn": (SpawnConfig, "Workers on other hosts. A `[[host]]` table overrides these."),
    "demo": (DemoConfig, "`dreamfleet demo`."),
    "iterate": (IterateConfig, "`dreamfleet iterate`."),
    "vae": (
        (TrainConfig, VAEConfig),
        "`dreamfleet train vae`, over its preset; each key may be given as `--set KEY=VALUE`.",
    ),
    "mdnrnn": (
        (TrainConfig, MDNRNNConfig),
        "`dreamfleet train mdnrnn`, over its preset; each key may be given as `--set KEY=VALUE`.",
    ),
    "baseline": (
        (LearningConfig, AgentConfig),
        "`dreamfleet baseline train`, over its preset; each key may be given as `--set KEY=VALUE`.",
    ),
}
OFTEN = 8  # words from which on a row that several verbs have stands once, before the verbs
ALL_VERBS = ("config", "log_level", "log_format", "trust", "help", "help_all")  # names of flags that each verb has
OF_ONE_VERB = ("dashboard", "serve", "demo", "iterate", "router")  # tables that only the verb of that name reads
LARGE = 1e9  # a bound from here on only guards the wire
JSON = "print the answer as JSON"
UNITS = {
    "run.horizon": "steps", "run.patience": "steps", "run.evaluate_every": "generations",
    "run.collect_every": "generations", "run.temperature": "factor", "run.sigma0": "parameter units",
    "limits.generations": "generations", "limits.steps": "environment steps", "limits.minutes": "minutes of work",
    "limits.parted": "evaluations", "limits.target": "score", "network.beat": "seconds",
    "worker.drain_timeout": "seconds", "worker.lifetime": "seconds", "worker.slot_memory": "MiB",
    "worker.coordinator_timeout": "seconds",
}  # fmt: skip
RUN_ARGUMENTS = Path(__file__).parents[1] / "dreamfleet" / "experiments" / "local" / "run_arguments.py"
RUN_ARGUMENTS_HEAD = '''"""Settings of `start_run` and `evolve`. `make reference` writes it: change `RunConfig`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypedDict

_Keywords = TypedDict("_Keywords", {{{items}}}, total=False)  # words of Python: given by `**`


class RunArguments(_Keywords, total=False):
    """The flags of `dreamfleet coordinator`, with `_` for `-`; docs/reference/verbs.md says what each means."""

{body}
'''
SETTINGS_HEAD = f"""{NOTE}
# Settings

Each setting is a key of the configuration file, an environment variable and, for the verbs that use it, a flag. A flag
overrides the variable, and the variable overrides the file. [How to configure a fleet](../how-to/configure.md) has an
example.

- The flag of `evaluate_every` is `--evaluate-every`. A setting that is true or false has `--no-NAME` too.
- The variable of `population` in the table `[run]` is `DREAMFLEET_RUN_POPULATION`, that of the shared `connect`
  `DREAMFLEET_CONNECT`.
- A setting without a default is unset.
- A variable holds a list as texts between commas. An empty variable counts as unset, but it empties a text or a list.
- `DREAMFLEET_CONFIG` names the configuration file, and `DREAMFLEET_CACHE` the folder of downloaded world models.
- With `DREAMFLEET_PICTURES=gymnasium`, gymnasium drives and draws CarRacing, which takes 15 times as long. Scores are
  the same.
- `[[stage]]` tables are described in [stages of one run](../how-to/stages.md), `[[host]]` tables in
  [workers on other hosts](../how-to/hosts.md).
"""
VERBS_HEAD = f"""{NOTE}
# Verbs

`dreamfleet VERB --help` shows a verb's first flags, and `--help-all` all of them.
[Exit codes](exit-codes.md) says how a verb ends.

A word in capitals stands for a value: `--run RUN`. *Settings* names the tables of [settings](settings.md) whose keys
are flags of that verb too, or those of their keys that are. *Common* flags are described [below](#common-flags).
`--json`, where a verb has it beside these, prints the answer as JSON. Each verb also has these:

"""


def write() -> None:
    """Write both pages, and the types of a run's settings in Python."""
    for name, text in pages().items():
        (FOLDER / name).write_text(text)
    RUN_ARGUMENTS.write_text(run_arguments())


def pages() -> dict[str, str]:
    """The text of each page, by its file name."""
    return {"verbs.md": verbs_page(), "settings.md": settings_page()}


def run_arguments() -> str:
    """The module with the types of what `start_run` and `evolve` take: the flags of `coordinator`."""
    parser = build_parser("coordinator", run_setup)
    flags = {
        flag.removeprefix("--").replace("-", "_"): each for each in parser._actions for flag in each.option_strings
    }
    rows = {name: f"{_python_type(flags[name])} | None" for name in setting_names(parser)}
    head = {name: rows.pop(name) for name in list(rows) if iskeyword(name)}
    items = ", ".join(f'"{name}": {hint}' for name, hint in head.items())
    body = "\n".join(f"    {name}: {hint}" for name, hint in rows.items())
    return RUN_ARGUMENTS_HEAD.format(items=items, body=body)


def _python_type(action: argparse.Action) -> str:
    """The type of a setting in Python, as `flag_words` takes it."""
    shown = str(action.metavar)
    if isinstance(action, argparse.BooleanOptionalAction):
        return "bool"
    if action.choices:
        return "Literal[" + ", ".join(f'"{each}"' for each in action.choices) + "]"
    if action.nargs == "+":
        return "Mapping[str, Any] | Sequence[str]" if "=" in shown else "str | Sequence[str]"
    if action.dest == "metrics_port":  # a port, or ADDRESS:PORT
        return "int | str"
    if shown in ("BUNDLE", "CONTROLLER", "FILE", "SUBSPACE"):
        return "str | Path"
    return {int: "int", float: "float"}.get(action.type, "str")  # type: ignore[call-overload,no-any-return]


def settings_page() -> str:
    """Every setting by table: key, variable, default, values and meaning."""
    parts = [SETTINGS_HEAD]
    for table, (section, about) in SECTIONS.items():
        parts += [f"\n## {_title(table)}\n", f"{about}\n", *_settings_table(table, section)]
    return "\n".join(parts) + "\n"


def _settings_table(table: str, section: type | tuple[type, ...]) -> Iterator[str]:
    hints = {name: hint for each in _types(section) for name, hint in get_type_hints(each, include_extras=True).items()}
    known = _known_before(table, section)
    if known:
        yield f"As above: {', '.join(f'`{each}`' for each in known)}.\n"
    yield "| key | default | values | meaning |\n|---|---|---|---|"
    for each in _settings(section):
        if each.name in known:
            continue
        values = ", ".join(filter(None, (_values(hints[each.name]), UNITS.get(f"{table}.{each.name}"))))
        yield f"| `{each.name}` | {_default(each)} | {values} | {_cell(_plain_help(each.metadata['help']))} |"


def _known_before(table: str, section: type | tuple[type, ...]) -> list[str]:
    """The settings of a table whose dataclass an earlier table has, too."""
    tables = list(SECTIONS)
    before = {each for one in tables[: tables.index(table)] for each in _types(SECTIONS[one][0])}
    return [each.name for one in _types(section) if one in before for each in _settings(one)]


def verbs_page() -> str:
    """Every verb of this distribution by group: its summary, the tables that it reads, and its own flags."""
    points = {each.name: each for each in entry_points(group=GROUP) if each.value.startswith("dreamfleet.")}
    parsers = {name: build_parser(name, load_verb(point)) for name, point in points.items()}
    common = [each for each in parsers["status"]._actions if each.dest in ALL_VERBS]
    often = _rows_of_several(parsers)
    parts = [VERBS_HEAD + _flags_table([_row(each) for each in common])]
    parts += ["\n## Common flags\n", _flags_table(sorted(often))]
    for heading, names in _groups(points).items():
        parts.append(f"\n## {heading}")
        for name in names:
            parts += ["", *_verb(name, load_verb(points[name]).SUMMARY, parsers[name], often)]
    return "\n".join(parts) + "\n"


def _rows_of_several(parsers: Mapping[str, argparse.ArgumentParser]) -> set[str]:
    """Of each flag the row of `OFTEN` words or more that most verbs have, two at least."""
    rows = Counter(
        _row(each) for name, parser in parsers.items() for each in _own(name, parser)[0] if each.option_strings
    )
    several = [row for row, count in rows.most_common() if count > 1 and len(row.replace("|", "").split()) >= OFTEN]
    return {*{_flag_of(row): row for row in reversed(several)}.values()}


def _verb(name: str, summary: str, parser: argparse.ArgumentParser, often: Set[str]) -> Iterator[str]:
    yield f"### {name.replace('.', ' ')}\n"
    yield f"{_sentence(summary)}\n"
    own, of_tables = _own(name, parser)
    rows = [_row(each) for each in own]
    shared = ", ".join(_flag_of(row) for row in rows if row in often)
    lines = [f"*Settings:* {', '.join(_keys_of(parser, each) for each in of_tables)}." if of_tables else ""]
    lines += [f"*[Common](#common-flags):* {shared}." if shared else ""]
    lines += ["`--json`." if any(_help(each) == JSON for each in parser._actions) else ""]
    if any(lines):
        yield " ".join(filter(None, lines)) + "\n"
    if rest := [row for row in rows if row not in often]:
        yield _flags_table(rest)


def _own(name: str, parser: argparse.ArgumentParser) -> tuple[list[argparse.Action], list[str]]:
    """The flags that a verb alone describes, and the tables of settings that it reads."""
    titles = {id(each): group.title or "" for group in parser._action_groups for each in group._group_actions}
    flags = [each for each in parser._actions if each.dest not in ALL_VERBS and _help(each) != JSON]
    tables = [_table_of(name, each, titles.get(id(each), "")) for each in flags]
    own = [each for each, table in zip(flags, tables, strict=True) if table is None]
    return own, [each for each in dict.fromkeys(tables) if each is not None]


def _keys_of(parser: argparse.ArgumentParser, table: str) -> str:
    """A table's link where a verb takes all of its keys, else the flags that it takes of it."""
    taken = {each.dest for each in parser._actions} - {*ALL_VERBS}
    flagged = [
        one.name
        for one in _settings(SECTIONS[table][0])
        if one.metadata.get("flag", True) and one.name not in ALL_VERBS
    ]
    link = f"[{_title(table).removesuffix(' settings')}](settings.md#{_anchor(_title(table))})"
    if taken.issuperset(flagged):
        return link
    names = [each.replace("_", "-") for each in flagged if each in taken]
    return f"{link} ({', '.join(f'`--{each}`' for each in names)})"


def _flags_table(rows: Sequence[str]) -> str:
    return "\n".join(("| flag | default | meaning |\n|---|---|---|", *rows))


def _row(action: argparse.Action) -> str:
    return f"| {_flag(action)} | {_own_default(action)} | {_cell(_plain_help(_help(action)))} |"


def _flag_of(row: str) -> str:
    """The first cell of a row, without its value: `--task` of `--task TASK`."""
    return re.sub(r"(--[\w-]+)[^`]*`.*", r"\1`", row.partition(" | ")[0].removeprefix("| ")).removesuffix(" ...")


def _flag(action: argparse.Action) -> str:
    if not action.option_strings:
        shown = action.metavar or action.dest.upper()
        return f"`{' '.join(shown) if isinstance(shown, tuple) else shown}`" + (
            " ..." if action.nargs in ("+", "*") else ""
        )
    names = [each for each in action.option_strings if not each.startswith("--no-") or len(action.option_strings) == 1]
    value = ""
    if action.nargs != 0 and not isinstance(action, argparse.BooleanOptionalAction):
        shown = action.metavar or ("" if action.choices else action.dest.upper())
        shown = " ".join(shown) if isinstance(shown, tuple) else shown
        value = f" [{shown}]" if action.nargs == "?" else f" {shown}" if shown else ""
    more = " ..." if action.nargs in ("+", "*") else ""
    chosen = " " + ", ".join(f"`{each}`" for each in action.choices) if action.choices else ""
    return ", ".join(f"`{each}{value}`" for each in names) + more + chosen


def _help(action: argparse.Action) -> str:
    """The help text; of a flag that the short help hides, the text that it keeps for the long one."""
    shown = action.help if action.help not in (None, argparse.SUPPRESS) else getattr(action, "full_help", "")
    return (shown or "") % {**vars(action), "prog": "dreamfleet"} if "%(" in (shown or "") else (shown or "")


def _own_default(action: argparse.Action) -> str:
    found = re.search(r"\(default:? ([^()]*)\)$", _help(action))
    if found:
        return _cell(found[1])
    shown = action.default
    return "" if shown in (None, False, argparse.SUPPRESS, (), [], "") or not action.option_strings else f"`{shown}`"


def _plain_help(text: str) -> str:
    """A help text as a cell: without the default at its end, which has a column."""
    return re.sub(r" \(default:? [^()]*\)$", "", " ".join(text.split())).replace("%%", "%")


def _table_of(verb: str, action: argparse.Action, title: str) -> str | None:
    """The table of the configuration file that a verb's flag sets, or None: name and text are those of the field."""
    for table, (section, _) in SECTIONS.items():
        other = isinstance(section, tuple) or (table in OF_ONE_VERB and table != verb)
        for each in () if other else _settings(section):
            if each.name == action.dest and f"--{each.name.replace('_', '-')}" in action.option_strings:
                text = _help(action)
                if text.startswith(each.metadata["help"]) or (not text and title == _group_title(_types(section)[0])):
                    return table
    return None


def _group_title(section: type) -> str:
    return section.__name__.removesuffix("Config").lower()


def _groups(points: Mapping[str, EntryPoint]) -> dict[str, list[str]]:
    """Names of verbs by heading, as the overview of `dreamfleet --help` has them."""
    try:
        known = import_module("dreamfleet.common.cli.overview").GROUPS
    except ModuleNotFoundError:
        known = {}
    groups = {
        heading: [name for names in entries for name in names if name in points] for heading, entries in known.items()
    }
    rest = sorted(points.keys() - {name for names in groups.values() for name in names})
    return {**groups, **({"Other verbs" if groups else "All verbs": rest} if rest else {})}


def _types(section: type | tuple[type, ...]) -> tuple[type, ...]:
    return section if isinstance(section, tuple) else (section,)


def _settings(section: type | tuple[type, ...]) -> Iterator[Field[Any]]:
    """The fields that a user may set."""
    return (each for one in _types(section) for each in fields(one) if "help" in each.metadata)


def _default(each: Field[Any]) -> str:
    if found := re.search(r"\(default:? ([^()]*)\)$", each.metadata["help"]):
        return _cell(found[1])
    if each.default in (MISSING, None, (), ""):
        return ""
    return f"`{str(each.default).lower() if isinstance(each.default, bool) else each.default}`"


def _values(hint: Any) -> str:
    """What a setting may be, in words: its type, its bounds, its choices."""
    if get_origin(hint) is Annotated:
        base, *bounds = get_args(hint)
        limits = [_bounds(each.ge, each.le) for each in bounds if each.ge is not None]
        return " ".join((_values(base), *limits))
    if get_origin(hint) is Union or type(hint).__name__ == "UnionType":
        return next(_values(each) for each in get_args(hint) if each is not type(None))
    if get_origin(hint) is Literal:
        return ", ".join(f"`{each}`" for each in get_args(hint))
    if get_origin(hint) is tuple:
        return "texts" if get_args(hint)[0] is str else "numbers"
    return {int: "integer", float: "number", bool: "boolean", str: "text", Path: "path"}[hint]


def _bounds(low: float, high: float) -> str:
    return f"from {low:g}" if high >= LARGE else f"{low:g} to {high:.7g}"


def _title(table: str) -> str:
    return f"[{table}]" if table else "Shared settings"


def _anchor(title: str) -> str:
    return re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")


def _sentence(text: str) -> str:
    return _cell(text[:1].upper() + text[1:]) + ("" if text.endswith(".") else ".")


def _cell(text: str) -> str:
    """Text for a table's cell: bars and angle brackets are escaped."""
    return text.replace("|", r"\|").replace("<", "&lt;")


if __name__ == "__main__":
    write()
