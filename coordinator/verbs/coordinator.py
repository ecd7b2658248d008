"""`dreamfleet coordinator`: start or continue a run."""

from __future__ import annotations

import argparse
import logging
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from dreamfleet.common.config import Table, add_flags, given, load
from dreamfleet.common.descriptors import raise_limit
from dreamfleet.common.errors import UsageError
from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.network import Network
from dreamfleet.common.site import joined, offer
from dreamfleet.common.unblocked import unblock_stderr
from dreamfleet.coordinator.config import NO_SUBSPACE, LimitsConfig, NetworkConfig, RunConfig
from dreamfleet.coordinator.presets import find_preset
from dreamfleet.coordinator.schedule import find_schedule, unfold

if TYPE_CHECKING:
    from dreamfleet.common.runs import RunFolder
    from dreamfleet.coordinator.main import RunRequest
    from dreamfleet.coordinator.run import Run
    from dreamfleet.coordinator.start import Start

SUMMARY = "start a run: CMA-ES decides, workers score"
EXTRAS: tuple[str, ...] = ()
LEFT_OPEN = 130
log = logging.getLogger("dreamfleet.coordinator")


@dataclass(frozen=True)
class Outcome:
    """What a verb has to say of a run that ended, beside what is always said, and its exit code."""

    text: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    code: int = 0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    name = parser.add_mutually_exclusive_group()
    name.add_argument("--run", dest="run_name", default="run", help="name of the new run (default run)")
    name.add_argument("--resume", metavar="RUN", help="continue this run from its journal, with the limits and the "
                      "network that it last had where no other are given")  # fmt: skip
    parser.add_argument(
        "--init",
        metavar="CONTROLLER",
        help="begin with these parameters instead of zeros: a file, a run, or what ships",
    )
    add_settings(parser)


def add_settings(parser: argparse.ArgumentParser, default: str | None = None) -> None:
    """The arguments of whatever serves a run; `default` is shown instead of the settings' defaults."""
    add_json(parser)
    offer(parser, "runs_dir", "join", "access_dir")
    add_flags(parser, RunConfig, default=default)
    add_flags(parser, LimitsConfig, NetworkConfig)


def run(args: argparse.Namespace) -> int:
    """Serve the run until it ends; Ctrl-C leaves it to be continued."""
    from dreamfleet.coordinator.start import find_start

    if args.resume and args.init:
        raise UsageError("--init is of a new run: a continued one has its parameters; `fork` begins another from it")
    if args.resume:
        return _resume(args)
    return serve(args, {}, find_start(args.init, args.runs_dir) if args.init else None)


def serve(
    args: argparse.Namespace, base: Table, start: Start | None,
    looked_at: Callable[[RunConfig], RunConfig] = lambda config: config,
) -> int:  # fmt: skip
    """Serve a new run, whose settings are those of `base` where nothing else is said, once they were `looked_at`."""
    config, limits = configured(args, base)
    config = looked_at(config)
    return serve_request(args, request_of(args, args.run_name, config, limits, {}, start))


def configured(args: argparse.Namespace, base: Table) -> tuple[RunConfig, LimitsConfig]:
    """What a new run is, and when it ends, as its flags, the environment and the file say."""
    config = _searched(_scheduled(args, load(RunConfig, "run", base=base, preset=find_preset, **args.sources)))
    limits = load(LimitsConfig, "limits", **args.sources)
    _check_target(limits, config.evaluate_every)
    return config, limits


def _scheduled(args: argparse.Namespace, config: RunConfig) -> RunConfig:
    """The configuration with the stages that its schedule, or the configuration file, holds."""
    found = find_schedule(config.schedule, args.sources["file"])
    if found is None:
        return config
    twice = [name for name in unfold(found)[0] if name in args.given]
    if twice:
        raise UsageError(f"--{twice[0]} and {twice[0]} of stage 1 are the same setting: leave one of them out")
    return replace(config, stages=found)


def _searched(config: RunConfig) -> RunConfig:
    """The configuration with the subspace that it names."""
    from dreamfleet.common.shelf import find_subspace

    if config.subspace is None:
        return config
    if not config.subspace:
        raise UsageError(f"--subspace is empty: name a file of `dreamfleet subspace`, or {NO_SUBSPACE}")
    return replace(config, searched=None if config.subspace == NO_SUBSPACE else find_subspace(config.subspace))


def _resume(args: argparse.Namespace) -> int:
    from dreamfleet.common.runs import open_run
    from dreamfleet.coordinator.kept import kept_limits, kept_network

    with open_run(args.runs_dir, args.resume) as stored:
        _refuse_frozen(args)
        _tell_frozen(args, stored)
        limits = load(LimitsConfig, "limits", base=kept_limits(stored), **args.sources)
        _check_target(limits, stored.settings.evaluate_every)
        request = request_of(args, args.resume, None, limits, kept_network(stored), None)
        before = len(stored.history())
    return serve_request(args, request, before)


def request_of(
    args: argparse.Namespace, name: str, config: RunConfig | None, limits: LimitsConfig, kept: Table,
    start: Start | None,
) -> RunRequest:  # fmt: skip
    """What is to be served where the arguments say, else where it was `kept`; without `config` it is continued."""
    from dreamfleet.coordinator.kept import choose_addresses, settle_strict
    from dreamfleet.coordinator.main import RunRequest

    base = {key: value for key, value in kept.items() if key not in ("listen", "connect")}
    own = load(NetworkConfig, "network", base=base, **args.sources)
    if own.mixed:
        log.warning("--mixed is deprecated: a run takes any host unless it is --strict (--no-strict loosens one)")
    own = settle_strict(own, said="strict" in args.given)
    credentials = joined(args, ("coordinator",))
    network = choose_addresses(own, args.site, kept, credentials)
    Network(network.listen, network.connect, credentials).check_open(insecure=network.insecure)
    site = args.site
    return RunRequest(name, args.runs_dir, config, limits, network, start, credentials, site.join, site.access_dir)


def serve_request(
    args: argparse.Namespace, request: RunRequest, before: int | None = None,
    judge: Callable[[], Outcome] = Outcome,
) -> int:  # fmt: skip
    """Serve until the run ends, and say how; of a run that ended, what `judge` finds too."""
    from dreamfleet.coordinator.main import serve_run

    unblock_stderr()
    raise_limit()
    run = serve_run(request, _stop_on_signals)
    _end_on_signals()  # its last word may wait for a reader of stdout
    outcome = Outcome(code=LEFT_OPEN) if run.ended is None else judge()
    _report(args, run, request, outcome, nothing_new=len(run.history) == before)
    return outcome.code


def _check_target(limits: LimitsConfig, evaluate_every: int) -> None:
    if limits.target is not None and not evaluate_every:
        raise UsageError("--target is reached by an evaluated mean: give --evaluate-every too")


def _refuse_frozen(args: argparse.Namespace) -> None:
    if flags := [f"--{each.name.replace('_', '-')}" for each in fields(RunConfig) if each.name in args.given]:
        raise UsageError(
            f"{', '.join(flags)}: frozen with run {args.resume}; `dreamfleet fork {args.resume}` begins another run "
            "from it"
        )


def _tell_frozen(args: argparse.Namespace, stored: RunFolder) -> None:
    """A file serves many runs: what it says of another one is no error, but is not silently passed over either."""
    from dreamfleet.coordinator.config import settings_of

    said = given(RunConfig, "run", args.sources["file"], args.sources["environment"])
    said = {**(find_preset(said.pop("preset")) if "preset" in said else {}), **said}
    given_stages, own_stages = find_schedule(said.pop("schedule", None), args.sources["file"]), said.pop("stages", ())
    named, stages = unfold(own_stages if given_stages is None else given_stages)
    said |= named
    _tell_subspace(said.pop("subspace", None), stored)
    if stages and stages != stored.settings.stages:
        log.warning("run %s keeps its own schedule; the settings say another", stored.name)
    frozen: dict[str, Any] = settings_of(stored.settings, stored.bundle_path)
    for name, value in said.items():
        if name != "bundle" and frozen.get(name, value) != value:
            log.warning("%s is %s in run %s, which keeps it; the settings say %s", name, frozen[name], stored.name,
                        value)  # fmt: skip


def _tell_subspace(name: str | None, stored: RunFolder) -> None:
    """The run has its own, whole; the file of another one may be gone."""
    from dreamfleet.common.shelf import find_subspace

    if name is None:
        return
    try:
        said = "" if name == NO_SUBSPACE else find_subspace(name).sha256
    except UsageError:
        said = None
    if said != stored.settings.subspace:
        log.warning("run %s keeps to what it was begun to search; the settings name another subspace", stored.name)


def _stop_on_signals(stop: Callable[[], None]) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop())


def _end_on_signals() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)


def _report(
    args: argparse.Namespace, run: Run, request: RunRequest, outcome: Outcome, *, nothing_new: bool
) -> None:  # fmt: skip
    from dreamfleet.common.eta import duration
    from dreamfleet.common.runs import CONTROLLER
    from dreamfleet.common.stored import told

    again = request.again()
    path = request.folder / CONTROLLER
    controller = path if path.is_file() else None
    facts: dict[str, Any] = {"run": request.name, "ended": run.ended, "controller": controller, "continue": again}
    facts["best"] = None if run.best is None else vars(run.best)
    facts["confirmed"] = None if run.confirmed is None else {**vars(run.confirmed), "error": run.confirmed.error}
    judged = run.confirmed or run.best
    score = f"; {told(judged)}" if judged else ""
    if run.ended is None:
        text = f"left run {request.name} open{score}; continue it with: {again}"
    else:
        where = f"; controller: {controller}" if controller else "; it has no controller yet"
        more = f"; it goes on with wider limits, such as: {again} --generations 0 --minutes 30" if nothing_new else ""
        lasted = (datetime.now(UTC) - datetime.fromisoformat(run.created)).total_seconds()
        ended = f"ended after {run.ended} (begun {duration(lasted)} ago)"
        text = f"run {request.name} {ended}{score}{where}{outcome.text or more}"
    if run.ended is None and not args.json:
        print(text, file=sys.stderr)
    else:
        answer(args, text, **facts, **outcome.facts)
