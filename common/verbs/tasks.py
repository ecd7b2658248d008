"""`dreamfleet tasks`: the tasks that this installation can score."""

from __future__ import annotations

import argparse
import json
from importlib.metadata import EntryPoint

from dreamfleet.common.cli.output import print_rows

SUMMARY = "list the tasks that installed packages register, and what keeps one from running here"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--json", action="store_true", help="print them as JSON")


def run(args: argparse.Namespace) -> int:
    """Print one line per task; exit 0 even if one cannot run."""
    from dreamfleet.common.protocol.tasks import registered_tasks

    rows = [_row(name, point) for name, point in registered_tasks().items()]
    if args.json:
        print(json.dumps(rows, indent=2))
        return 0
    print_rows([{name: row[name] for name in ("task", "package", "here")} for row in rows])
    return 0


def _row(name: str, point: EntryPoint) -> dict[str, object]:
    from dreamfleet.common.protocol.tasks import GYM

    distribution = "-" if point.dist is None else f"{point.dist.name} {point.dist.version}"
    shown = f"{name}:ENVIRONMENT" if name == GYM else name
    try:
        made = point.load()
    except ModuleNotFoundError as error:
        lacks = f"lacks the package {error.name!r}: pip install 'dreamfleet[worker]' if it is one of ours"
        return {"task": shown, "package": distribution, "ready": False, "here": lacks}
    except Exception as error:  # whatever a package raises as it is imported
        return {"task": shown, "package": distribution, "ready": False, "here": f"cannot be loaded: {error}"}
    text = str(made.__doc__ or "").strip().partition("\n")[0]
    return {"task": shown, "package": distribution, "ready": True, "here": f"ready: {text}" if text else "ready"}
