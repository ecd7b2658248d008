"""`dreamfleet tasks`: the tasks that this installation can score, or the check of one of them."""

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict
from importlib.metadata import EntryPoint
from importlib.util import find_spec

from dreamfleet.common.addons.task_check.task_check import TaskReport, try_task
from dreamfleet.common.cli.key_values import ENVIRONMENT_EXAMPLE, parse_arguments
from dreamfleet.common.cli.output import print_rows
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.packages import GYMNASIUM, PACKAGES, install_command, wrong_version
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.tasks import check_task, is_self_describing, registered_tasks, written_name

SUMMARY = "list the tasks that installed packages register, or check one as a run does before it begins"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "task", nargs="?", metavar="TASK", help="check this one, such as gym:LunarLander-v3: make, reset and step it"
    )
    parser.add_argument(
        "--environment", nargs="+", default=(), metavar="KEY=VALUE", help="arguments of gym:ENVIRONMENT, as in JSON"
    )
    parser.add_argument(
        "--observation", nargs="+", default=(), metavar="KEY",
        help="keys of the Dict that gym:ENVIRONMENT observes which the controller sees (default all that are numbers)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print them as JSON")


def run(args: argparse.Namespace) -> int:
    """Print one line per task, and exit 0 even if one cannot run; or check one, and exit 1 if it cannot be scored."""
    points = registered_tasks()
    if args.task in points and not is_self_describing(args.task):  # its runs need a world model
        points = {args.task: points[args.task]}
    elif args.task is not None:
        return _check(args)
    if args.environment or args.observation:
        raise UsageError(
            "--environment and --observation need one gym:ENVIRONMENT: name it, such as gym:LunarLander-v3"
        )
    rows = [_row(name, point) for name, point in points.items()]
    if args.json:
        print(json.dumps(rows, indent=2))
        return 0
    print_rows([{name: row[name] for name in ("task", "package", "here")} for row in rows])
    return 0


def _check(args: argparse.Namespace) -> int:
    check_task(args.task)
    arguments = parse_arguments("--environment", args.environment, ENVIRONMENT_EXAMPLE)
    given = {"environment": arguments, "observation": list(args.observation)}
    found = try_task(args.task, {key: value for key, value in given.items() if value})
    if args.json:
        print(json.dumps({"task": args.task, **asdict(found)}, indent=2))
    else:
        print_rows([{"check": name, "result": text} for name, text in _findings(found)])
    return 1 if found.fault else 0


def _findings(found: TaskReport) -> Iterator[tuple[str, str]]:
    if found.fault or found.description is None:
        yield "cannot be scored", found.fault
        return
    about = found.description
    sizes = f"{about.observations} observations, {about.outputs} outputs" if about.observations else (
        f"a function of {plural(about.outputs, 'parameter')}"
    )  # fmt: skip
    yield "can be scored", f"{sizes}, {', '.join(about.packages)}"
    if found.compared:
        what, values = ("seeds", "episodes") if about.observations else ("arguments", "values")
        yield ("not deterministic", found.varies) if found.varies else (f"equal {what}", f"give equal {values}")
    yield from (("warning", text) for text in found.warnings)


def _row(name: str, point: EntryPoint) -> dict[str, object]:
    distribution = "-" if point.dist is None else f"{point.dist.name} {point.dist.version}"
    shown = written_name(name)
    try:
        made = point.load()
    except ModuleNotFoundError as error:
        lacks = f"lacks the package {error.name!r}: pip install 'dreamfleet[worker]' if it is one of ours"
        return {"task": shown, "package": distribution, "ready": False, "here": lacks}
    except Exception as error:  # whatever a package raises as it is imported
        here = f"cannot be loaded: {wrong_version(GYMNASIUM) or error}"
        return {"task": shown, "package": distribution, "ready": False, "here": here}
    for package in getattr(getattr(made, "world", None), "packages", ()):
        module, extra = PACKAGES.get(package, ("sys", ""))
        if find_spec(module) is None:
            lacks = f"lacks the package {package!r}: {install_command(extra)}"
            return {"task": shown, "package": distribution, "ready": False, "here": lacks}
    text = str(made.__doc__ or "").strip().partition("\n")[0]
    return {"task": shown, "package": distribution, "ready": True, "here": f"ready: {text}" if text else "ready"}
