"""`dreamfleet iterate`: world models and evolutions in their dreams, in turn."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.config import add_flags, given, load
from dreamfleet.common.errors import UsageError
from dreamfleet.common.listing import add_json, answer, print_rows
from dreamfleet.common.site import offer
from dreamfleet.coordinator.config import DEFAULT_BUNDLE, LimitsConfig, RunConfig
from dreamfleet.coordinator.iteration.config import IterateConfig

if TYPE_CHECKING:
    from dreamfleet.common.stopping import Stop
    from dreamfleet.coordinator.iteration.evolving import Crew
    from dreamfleet.coordinator.iteration.iteration import Iteration
    from dreamfleet.coordinator.iteration.layout import Layout
    from dreamfleet.coordinator.iteration.ledger import Ledger

SUMMARY = "make world models and evolve in their dreams in turn, each learning from what the last one's means drove"
EXTRAS = ("train", "views")
PACKAGES = ("gymnasium", "matplotlib", "onnx", "onnxruntime", "safetensors", "torch")
OURS = {"run_name": "run", "resume": None, "init": None}  # of the rounds' runs, beside those of the next line
OURS |= dict.fromkeys(("bundle", "seed", "runs_dir", "listen", "connect", "config", "subspace"))


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--data", type=Path, required=True, help="the iteration's folder; one that was begun goes on")
    parser.add_argument(
        "--redo", metavar="ROUND/PHASE", help="first forget this phase and all behind it, such as 2/mdnrnn"
    )
    add_json(parser)
    offer(parser, "listen", texts={"listen": "workers of any host find the rounds' runs here (default: none do)"})
    add_flags(parser, IterateConfig)
    parser.add_argument(
        "--from-zero", dest="go_on", action="store_const", const=False, default=argparse.SUPPRESS,
        help="begin each evolution at zero, as without --go-on",
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Go on until all rounds are finished, and tell what came of them."""
    from dreamfleet.common.stopping import heeding_signals
    from dreamfleet.coordinator.iteration.iteration import held
    from dreamfleet.coordinator.iteration.layout import Layout

    for package in PACKAGES:
        if find_spec(package) is None:  # said now rather than after hours
            raise ModuleNotFoundError(name=package)
    layout = Layout(args.data)
    with held(layout), heeding_signals() as stop:
        iteration = _open(args, layout, stop)
        _go_on(iteration)
    _tell(args, layout, iteration.ledger)
    return 0


def _open(args: argparse.Namespace, layout: Layout, stop: Stop) -> Iteration:
    from dreamfleet.coordinator.iteration.iteration import Iteration
    from dreamfleet.coordinator.iteration.ledger import Ledger
    from dreamfleet.coordinator.iteration.plan import Phase

    begun = Ledger.load(layout.ledger)
    config = load(IterateConfig, "iterate", base=begun.settings if begun else None, **args.sources)
    more = _flags_before(args)
    settings = _run_settings(args, [*more, *config.flags_of_run(1)], new=begun is None)
    _run_settings(args, [*more, *config.flags_of_run(2)], new=begun is None)  # what is wrong with them is said now
    if config.go_on and "feedback=last" in settings["variant"]:
        raise UsageError(
            "--go-on fits a controller to the next model, and one with feedback=last cannot be: leave one out"
        )
    ledger = begun.take(config, settings, layout.root) if begun else Ledger.begin(config, settings)
    if config.local == 0 and not args.listen:
        raise UsageError("nobody would score: give --local slots here, or --listen for workers of other hosts")
    iteration = Iteration(layout, config, ledger, lambda: _crew(args, config, more, settings["task"]), stop)
    if args.redo:
        iteration.redo(Phase.of(args.redo))
    iteration.begin()
    iteration.ledger.save(layout.ledger)
    return iteration


def _flags_before(args: argparse.Namespace) -> tuple[str, ...]:
    """What a round's coordinator is told before `--run-flags`: the file, and the preset where nobody names one."""
    sources = args.sources
    named = "preset" in given(RunConfig, "run", sources["file"], sources["environment"])
    file = ("--config", str(args.config)) if args.config else ()
    return (*file, *(() if named else ("--preset", "dream")))


def _run_settings(args: argparse.Namespace, flags: list[str], *, new: bool) -> dict[str, Any]:
    """What the rounds' runs have in common, as their flags, the environment and the file say; checked if it is new."""
    from dreamfleet.common.bundle import find_bundle
    from dreamfleet.common.cli import parser_of
    from dreamfleet.coordinator.verbs import coordinator

    told = parser_of("coordinator", coordinator).parse_all(flags)
    if taken := [name for name, default in OURS.items() if getattr(told, name, default) != default]:
        names = ", ".join(f"--{name.replace('_name', '').replace('_', '-')}" for name in taken)
        raise UsageError(f"{names} in --run-flags: each round's run has its own, and --config is a flag of iterate")
    sources = {**args.sources, "flags": told}
    config, limits = coordinator.configured(
        argparse.Namespace(sources=sources, given=frozenset(vars(told))), base={}
    )  # fmt: skip
    if limits == LimitsConfig():
        raise UsageError("a round's run would never end: give --run-flags a limit, such as --generations 32")
    if new:
        replace(config, recorded=0.0).settings(find_bundle(DEFAULT_BUNDLE))  # which holds no recorded states
    return {**asdict(config), **asdict(limits), "preset": None, "schedule": None, "bundle": None, "searched": None}


def _crew(args: argparse.Namespace, config: IterateConfig, more: tuple[str, ...], task: str) -> Crew:
    from dreamfleet.coordinator.iteration.evolving import Crew

    own = ("--task", task) if ":" in task else ()
    return Crew.of(args.listen, config.local, more, own)


def _go_on(iteration: Iteration) -> None:
    from rich.console import Console

    from dreamfleet.coordinator.iteration.ledger import Entry
    from dreamfleet.coordinator.iteration.plan import Phase
    from dreamfleet.coordinator.iteration.summary import line

    console = Console(stderr=True, highlight=False)
    if finished := iteration.ledger.finished:
        console.print(f"{len(finished)} phases are finished, the last is {finished[-1]}", markup=False)
    with console.status("") as shown:

        def before(phase: Phase) -> None:
            shown.update(f"round {phase.round}: {phase.name}")

        def after(entry: Entry) -> None:
            console.print(line(entry), markup=False, soft_wrap=True)

        iteration.go_on(before, after)


def _tell(args: argparse.Namespace, layout: Layout, ledger: Ledger) -> None:
    from dreamfleet.coordinator.iteration import summary

    told = summary.rounds(layout, ledger)
    best, model = summary.best(told), told[ledger.kept(told[-1]["round"]) - 1]
    if args.json:
        answer(args, "", data=layout.root, rounds=told, best=best and best["round"], model=model["bundle"])
        return
    rows = summary.rows(told)
    print_rows(rows, right=tuple(rows[0])[1:])
    print(f"world model: {model['bundle']}")
    if best is not None:
        print(f"best controller: round {best['round']}'s, {summary.score(best['score'])}: {best['controller']}")
