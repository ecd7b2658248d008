"""`dreamfleet iterate`: world models and evolutions in their dreams, in turn."""

import argparse
import sys
from dataclasses import asdict, replace
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from dreamfleet.common.artifacts.actions import one_hot
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.world_facts import WorldFacts
from dreamfleet.common.cli.command_line import Configurable, build_parser
from dreamfleet.common.cli.config import add_flags, configured_values, load
from dreamfleet.common.cli.global_config import add_global_flags, load_credentials
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_next, print_rows
from dreamfleet.common.cli.presets import default_run_preset
from dreamfleet.common.cli.world_flags import OPTIONS
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.locks import folder_lock
from dreamfleet.common.files.regular_files import is_file
from dreamfleet.common.host.packages import check_modules
from dreamfleet.common.host.stop_signals import Stop, interrupted_by_signals, stop_on_signals
from dreamfleet.common.printable import plural
from dreamfleet.common.transport.network import Network
from dreamfleet.coordinator.settings import run_setup
from dreamfleet.coordinator.settings.config import DEFAULT_BUNDLE, DEFAULT_HORIZON, RunConfig, default_world
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.settings.start import find_start
from dreamfleet.experiments.iteration import summary
from dreamfleet.experiments.iteration.config import RUN_FLAGS, IterateConfig
from dreamfleet.experiments.iteration.layout import IterationFolder
from dreamfleet.experiments.iteration.ledger import FinishedPhase, IterationLedger
from dreamfleet.experiments.iteration.phases import find_init
from dreamfleet.experiments.iteration.plan import INIT, Phase
from dreamfleet.experiments.iteration.runner import Iteration
from dreamfleet.experiments.iteration.summary import format_entry
from dreamfleet.experiments.local.kept_words import accept, check_kept, chosen_code
from dreamfleet.experiments.local.local_run import LocalFleet, parse_run_flags, security_flags, task_flags
from dreamfleet.worker.addons.bundles import verb as bundle_verb
from dreamfleet.worker.training.stages.train import MODELS
from dreamfleet.worker.verbs import train

SUMMARY = (
    "make world models and evolve in their dreams in turn; each world model learns from drives of the last evolution"
)
EXTRAS = ("train", "views")
FIRST = (
    "--init --rounds --task --preset --drives --own-drives --run-flags --seed --local --jobs --device --redo "
    "--listen --json"
)
PACKAGES = ("gymnasium", "matplotlib", "onnx", "onnxruntime", "safetensors", "torch")
# The settings that are flags of other verbs: the verb, and what its parser needs before them.
WORDS: dict[str, tuple[str, Configurable, tuple[str, ...]]] = {
    **{f"{model}_flags": ("train", train, (model, "--data", ".")) for model in MODELS},
    "bundle_flags": ("bundle", bundle_verb, ("--data", ".", "--out", ".")),
    **dict.fromkeys(RUN_FLAGS, ("coordinator", run_setup, ())),
}
VARYING = ("preset", "schedule", "bundle", "loaded_subspace")  # to the rounds' runs, of all settings


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--data", type=Path, required=True, help="the iteration's folder; a begun one is resumed")
    parser.add_argument("--redo", metavar="ROUND/PHASE", help="first undo this phase and all later, such as 2/mdnrnn")
    add_json_flag(parser)
    listen = "workers of any host find the rounds' runs here (default: none do)"
    texts = {"listen": listen, "join": "a coordinator's join file, for the rounds' runs"}
    add_global_flags(parser, "listen", "join", "access_dir", texts=texts)
    add_flags(parser, NetworkConfig, only=["insecure"])
    add_flags(parser, IterateConfig)
    parser.add_argument(
        "--from-zero", dest="go_on", action="store_const", const=False, default=argparse.SUPPRESS,
        help="begin each evolution at zero, as without --go-on",
    )  # fmt: skip


@interrupted_by_signals()
def run(args: argparse.Namespace) -> int:
    """Run the phases that are left, and print what each round reached."""
    check_modules(PACKAGES)
    layout = IterationFolder(args.data)
    with folder_lock(layout.lock, "iteration"), stop_on_signals() as stop:
        iteration = _open_iteration(args, layout, stop)
        _run_phases(iteration, layout)
    _print_results(args, layout, iteration.ledger)
    return 0


def _open_iteration(args: argparse.Namespace, layout: IterationFolder, stop: Stop) -> Iteration:
    begun = IterationLedger.load(layout.ledger)
    config = load(IterateConfig, "iterate", base=begun.settings if begun else None, **args.sources)
    if is_file(Path(config.init)):
        config = replace(config, init=str(Path(config.init).resolve()))
    # Until --init has been copied, nothing was made, and all settings may change.
    new = begun is None or (not begun.entries and bool(config.init))
    # Before `--run-flags` come the config file, and the world's preset unless the settings name one.
    named = "preset" in configured_values(RunConfig, "run", args.sources["file"], args.sources["environment"])
    file = ("--config", str(args.config)) if args.config else ()
    more = (*file, *(() if named else ("--preset", default_run_preset(config.task))))
    first, limits = parse_run_flags([*more, *config.flags_of_run(1)], args.sources, "iterate")
    later, _ = parse_run_flags([*more, *config.flags_of_run(2)], args.sources, "iterate")  # wrong flags end it now
    _check_code(args, config, layout.ledger if begun else None)
    task = first.task or config.task or default_world()
    settings = {**asdict(first), **asdict(limits), **dict.fromkeys(VARYING), "task": task}
    settings["horizon"] = first.horizon or DEFAULT_HORIZON  # as it was when that was every world's default
    if new:
        for run in (first, later):
            _check_run(config, run, layout)
    if begun is None or new:
        ledger = IterationLedger.begin(config, settings)
    else:
        ledger = begun.with_settings(config, settings, layout.root)
    if config.local == 0 and not args.listen:
        raise UsageError("no worker would score: give --local slots here, or --listen for workers of other hosts")
    # The setting of flag, environment or file holds for the rounds' coordinators too.
    insecure = load(NetworkConfig, "network", **args.sources).insecure
    Network(args.listen, credentials=load_credentials(args, ("coordinator",))).check_open(insecure=insecure)
    own, security = task_flags(task, config.task), security_flags(args)

    def local_fleet() -> LocalFleet:
        join = args.global_config.join
        return LocalFleet.of(args.listen, config.local, more, own, join, security, insecure=insecure)

    listen = ("--listen", *args.listen) if args.listen else ()
    repeated = (*listen, *security, *(("--insecure",) if insecure else ()))
    iteration = Iteration(layout, config, ledger, local_fleet, stop, repeated)
    if args.redo:
        if (phase := Phase.of(args.redo)).name == INIT:
            find_init(config.init, layout.runs)  # before all that followed from it is removed
        iteration.redo(phase)
    whose = config.task or default_world()
    print(f"a world model of {whose}; each round's run has the preset {first.preset}", file=sys.stderr)
    iteration.begin()
    iteration.ledger.save(layout.ledger)
    return iteration


def _check_code(args: argparse.Namespace, config: IterateConfig, keeper: Path | None) -> None:
    """`UsageError` where settings that `keeper` has, and the user gives not now, choose code that is not trusted."""
    given = {*configured_values(IterateConfig, "iterate", args.sources["file"], args.sources["environment"])}
    for name, (verb, module, before) in WORDS.items():
        parsed = build_parser(verb, module).parse_all([*before, *config.flags(name)])
        _check_words(name, getattr(config, name), chosen_code(parsed), None if name in args.given | given else keeper)
    world = [getattr(config, name) for name in ("task", *OPTIONS)]
    code = chosen_code(argparse.Namespace(task=config.task, config=None))
    _check_words("task", world, code, None if "task" in args.given | given else keeper)


def _check_words(name: str, words: object, code: dict[str, str], keeper: Path | None) -> None:
    if keeper is None:
        accept([name, words], code)
    else:
        check_kept([name, words], code, keeper)


def _check_run(config: IterateConfig, run: RunConfig, layout: IterationFolder) -> None:
    """Check that a round's run can begin, in the shipped world model or in that of `--init`."""
    run = replace(run, recorded=0.0)  # a bundle need not hold recorded states yet
    if not config.init:
        settings = freeze(run, _stand_in(config))
    else:
        if is_file(Path(config.init)) and Path(config.init).is_relative_to(layout.root.resolve()):
            raise UsageError(f"--init {config.init} lies in the iteration's own folder: copy it elsewhere first")
        start, (_, bundle) = find_start(config.init, layout.runs), find_init(config.init, layout.runs)
        settings = freeze(start.apply_to(run) if config.go_on else run, bundle)
        if config.go_on:
            start.check(settings, bundle)
    if config.go_on and settings.task.option("feedback") == "last":
        raise UsageError("--go-on fits a controller to the next model, and one with feedback=last cannot be: omit one")


def _stand_in(config: IterateConfig) -> Bundle:
    """A world model for what a run's settings must fit: the shipped one, as if it were of the iteration's world."""
    shipped = find_bundle(DEFAULT_BUNDLE)
    if config.task in ("", shipped.manifest.task):
        return shipped
    facts = WorldFacts.of(one_hot(shipped.manifest.actions), packages=(), horizon=DEFAULT_HORIZON, frames_per_second=1)
    return Bundle(shipped.path, shipped.sha256, replace(shipped.manifest, task=config.task, world=facts))


def _run_phases(iteration: Iteration, layout: IterationFolder) -> None:
    console = Console(stderr=True, highlight=False)
    if finished := iteration.ledger.finished:
        console.print(f"finished: {plural(len(finished), 'phase')}, the last is {finished[-1]}", markup=False)
    with console.status("") as shown:
        doing = ""

        def on_begin(phase: Phase) -> None:
            nonlocal doing
            doing = f"round {phase.round}: {phase.name}"
            shown.update(escape(f"{doing}; {layout.round(phase.round) / 'logs'} shows how far"))

        def on_line(line: str) -> None:
            shown.update(escape(f"{doing}  {line}"))

        def on_finished(entry: FinishedPhase) -> None:
            console.print(format_entry(entry), markup=False, soft_wrap=True)

        iteration.run_remaining(on_begin, on_finished, on_line)


def _print_results(args: argparse.Namespace, layout: IterationFolder, ledger: IterationLedger) -> None:
    rounds = summary.describe_rounds(layout, ledger)
    # The last round may be unfinished, with a model that no gate has judged yet.
    counts = next(each["evolved_in"] for each in reversed(rounds) if each["evolved_in"] is not None)
    best, model = summary.best_round(rounds), str(layout.bundle(counts))
    if args.json:
        print_answer(args, "", data=layout.root, rounds=rounds, best=best and best["round"], model=model)
        return
    rows = summary.table_rows(rounds)
    print_rows(rows, right=tuple(rows[0])[1:])
    print(f"world model: {model}")
    if init := ledger.settings.get("init"):
        print(f"it began with {init}, which was not judged on these seeds: `dreamfleet compare` shows which is better")
    if best is not None:
        print(f"best controller: round {best['round']}'s, {summary.format_score(best['score'])}: {best['controller']}")
        print_next(args, *((verb, "--controller", best["controller"]) for verb in ("evaluate", "record")))
