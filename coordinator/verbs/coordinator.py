"""`dreamfleet coordinator`: start or continue a run. Pages: exit-codes.md."""

from __future__ import annotations

import argparse
import gc
import logging
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from dreamfleet.common.cli.config import Table, configured_values, load
from dreamfleet.common.cli.global_config import load_credentials
from dreamfleet.common.cli.output import print_answer
from dreamfleet.common.errors import StoppedError, UsageError
from dreamfleet.common.host.logs import label_logs
from dreamfleet.common.host.resource_limits import check_room_for_session, raise_open_file_limit
from dreamfleet.common.host.standard_streams import make_stderr_nonblocking
from dreamfleet.common.host.trusted_modules import trust
from dreamfleet.common.printable import format_duration, plural
from dreamfleet.common.protocol.tasks import module_of
from dreamfleet.common.transport.network import Network
from dreamfleet.coordinator.settings.config import NO_SUBSPACE, RunConfig
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.live_log import parse_sinks
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.settings.presets import find_preset
from dreamfleet.coordinator.settings.run_setup import DEFAULT_NAME, SUMMARY, check_limits, configure, load_run_config
from dreamfleet.coordinator.settings.stage_tables import find_schedule, split_first_stage

if TYPE_CHECKING:
    from dreamfleet.common.runs.run_folder import RunFolder
    from dreamfleet.coordinator.run.run import Run
    from dreamfleet.coordinator.service.main import RunRequest
    from dreamfleet.coordinator.settings.start import StartPoint

__all__ = ["EXTRAS", "SUMMARY", "configure", "run"]
EXTRAS: tuple[str, ...] = ()
FIRST = (
    "--run --resume --from --init --preset --task --bundle --population --episodes --horizon --seed --evaluate-every "
    "--generations --minutes --steps --target --listen --join --json"
)
ELSEWHERE = {
    "--workers": "workers are programs of their own: `dreamfleet worker --run NAME --slots N`",
    "--slots": "slots are a worker's: `dreamfleet worker --run NAME --slots N`",
    "--log-to": "give DREAMFLEET_NETWORK_LOG_TO=tensorboard, or `log_to` in a file's [network]",
}
# Python looks for cycles after every 700 new objects by default. A generation's jobs are many and have none.
COLLECTION = (100_000, 10, 10)
log = logging.getLogger("dreamfleet.coordinator")


@dataclass(frozen=True)
class ExitReport:
    """What a verb adds to the report of an ended run, and its exit code."""

    text: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    code: int = 0


def run(args: argparse.Namespace) -> int:
    """Serve the run until it ends; after Ctrl-C it can be resumed."""
    from dreamfleet.coordinator.settings.start import find_start

    if args.resume:
        if args.run_name is not None:
            raise UsageError("--run names a new run: a continued one keeps its name, so omit it or --resume")
        return _resume(args)
    if args.source:
        return _serve_fork(args)
    args.run_name = args.run_name or DEFAULT_NAME
    return serve_new_run(args, {}, find_start(args.init, args.runs_dir) if args.init else None)


def serve_new_run(
    args: argparse.Namespace, base: Table, start: StartPoint | None,
    adjust: Callable[[RunConfig], RunConfig] = lambda config: config,
) -> int:  # fmt: skip
    """Serve a new run: its settings over those of `base`, passed through `adjust`."""
    config, limits = load_run_config(args, base)
    config = adjust(config)
    return serve_request(args, build_request(args, args.run_name, config, limits, {}, start))


def _serve_fork(args: argparse.Namespace) -> int:
    """Serve a new run that begins where another one stands."""
    from dreamfleet.coordinator.settings.fork import Fork

    fork = Fork.of(args.runs_dir, args.source, args.given)
    args.run_name = args.run_name or f"{args.source}-fork"
    return serve_new_run(args, fork.settings, fork.start, fork.adapt)


def _resume(args: argparse.Namespace) -> int:
    from dreamfleet.common.runs.run_folder import open_run
    from dreamfleet.coordinator.settings.resume_settings import stored_limits, stored_network

    with open_run(args.runs_dir, args.resume) as stored:
        _refuse_frozen(args)
        _warn_ignored_settings(args, stored)
        limits = load(LimitsConfig, "limits", base=stored_limits(stored), **args.sources)
        check_limits(limits, stored.settings.evaluate_every, is_external=stored.settings.is_external)
        request = build_request(args, args.resume, None, limits, stored_network(stored), None)
        before = len(stored.history())
    return serve_request(args, request, before)


def build_request(
    args: argparse.Namespace, name: str, config: RunConfig | None, limits: LimitsConfig, kept: Table,
    start: StartPoint | None,
) -> RunRequest:  # fmt: skip
    """The run to serve, at the endpoints of the arguments or else of `kept`; without `config` it is resumed."""
    from dreamfleet.coordinator.service.main import RunRequest
    from dreamfleet.coordinator.settings.resume_settings import choose_addresses

    base = {key: value for key, value in kept.items() if key not in ("listen", "connect")}
    own = load(NetworkConfig, "network", base=base, **args.sources)
    credentials = load_credentials(args, ("coordinator",))
    network = choose_addresses(own, args.global_config, kept, credentials)
    Network(network.listen, network.connect, credentials).check_open(insecure=network.insecure)
    global_config = args.global_config
    trust(each.module for each in parse_sinks(load(NetworkConfig, "network", **args.sources).log_to))  # not the run's
    code = [module_of(config.optimiser)] if config else []
    code += [each.module for each in parse_sinks(own.log_to)]
    trusted = tuple(dict.fromkeys(filter(None, (*(global_config.trust if "trust" in args.given else ()), *code))))
    return RunRequest(
        name, args.runs_dir, config, limits, network, start, credentials, global_config.join, global_config.access_dir,
        trusted,
    )  # fmt: skip


def serve_request(
    args: argparse.Namespace, request: RunRequest, before: int | None = None,
    on_ended: Callable[[], ExitReport] = ExitReport,
) -> int:  # fmt: skip
    """Serve until the run ends and report how; `on_ended` adds to the report of a run that ended."""
    from dreamfleet.coordinator.service.main import serve_run

    raise_open_file_limit()
    check_room_for_session()  # before anything else starts a thread
    make_stderr_nonblocking()
    label_logs(f"run {request.name}")
    gc.set_threshold(*COLLECTION)
    run = serve_run(request, _on_signals)
    _on_signals(None)  # its last word may wait for a reader of stdout
    outcome = ExitReport(code=StoppedError.exit_code) if run.state.ended is None else on_ended()
    _report(args, run, request, outcome, nothing_new=len(run.history) == before)
    return outcome.code


def _refuse_frozen(args: argparse.Namespace) -> None:
    if flags := [f"--{each.name.replace('_', '-')}" for each in fields(RunConfig) if each.name in args.given]:
        from dreamfleet.common.runs.run_paths import run_command

        again = run_command(args.runs_dir / args.resume, "coordinator", "--from")
        raise UsageError(f"{', '.join(flags)}: frozen with run {args.resume}; `{again}` begins another run from it")


def _warn_ignored_settings(args: argparse.Namespace, stored: RunFolder) -> None:
    """Log a warning about settings of the config file that differ from the run's: a file may serve many runs."""
    from dreamfleet.coordinator.settings.config import config_values

    configured = configured_values(RunConfig, "run", args.sources["file"], args.sources["environment"])
    configured = {**(find_preset(configured.pop("preset")) if "preset" in configured else {}), **configured}
    given_stages, own_stages = (
        find_schedule(configured.pop("schedule", None), args.sources["file"]),
        configured.pop("stages", ()),
    )
    named, stages = split_first_stage(own_stages if given_stages is None else given_stages)
    configured |= named
    _warn_ignored_subspace(configured.pop("subspace", None), stored)
    if stages and stages != stored.settings.stages:
        log.warning("run %s keeps its own schedule; the settings say another", stored.name, extra=_kept("schedule"))
    frozen: dict[str, Any] = config_values(stored.settings, stored.bundle_path)
    for name, value in configured.items():
        if name != "bundle" and frozen.get(name, value) != value:
            log.warning("%s is %s in run %s, which keeps it; the settings say %s", name, frozen[name], stored.name,
                        value, extra=_kept(name))  # fmt: skip


def _warn_ignored_subspace(name: str | None, stored: RunFolder) -> None:
    """Warn if the settings name another subspace; the run stores its own, so the named file may be gone."""
    from dreamfleet.common.runs.lookup import find_subspace

    if name is None:
        return
    try:
        configured = "" if name == NO_SUBSPACE else find_subspace(name).sha256
    except UsageError:
        configured = None
    if configured != stored.settings.subspace:
        log.warning("run %s keeps its own subspace; the settings name another", stored.name, extra=_kept("subspace"))


def _kept(setting: str) -> dict[str, dict[str, str]]:
    return {"facts": {"event": "kept", "setting": setting}}


def _on_signals(act: Callable[[], None] | None) -> None:
    """Let the signals that stop a program do this; `None`: what they do by default."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL if act is None else lambda *_: act())


def _describe_failures(request: RunRequest, failed: int) -> str:
    """How many candidates failed, and why the first one did."""
    from dreamfleet.common.runs.run_folder import open_run

    if not failed:
        return ""
    with open_run(request.runs_dir, request.name) as stored:
        errors = [each.error for each in stored.failures() if each.kind == "score"]
    return f"; {plural(failed, 'candidate')} failed, first: {errors[0] if errors else 'its error is not kept'}"


def _report(args: argparse.Namespace, run: Run, request: RunRequest, outcome: ExitReport, *, nothing_new: bool) -> None:
    from dreamfleet.common.protocol.stop_kind import StopKind
    from dreamfleet.common.runs.records import describe_score, in_values, with_error
    from dreamfleet.common.runs.run_folder import open_run
    from dreamfleet.common.runs.run_paths import BUNDLE, CONTROLLER
    from dreamfleet.common.schema.times import elapsed_seconds
    from dreamfleet.common.worlds.score_words import score_word_of_run

    again, ended = request.resume_command(), run.state.ended
    path = request.folder / CONTROLLER
    controller = path if path.is_file() else None
    best, confirmed = run.background_jobs.evaluations.best, run.background_jobs.confirmed
    facts: dict[str, Any] = {
        "run": request.name, "ended": ended.text if ended else None, "controller": controller, "continue": again,
        "best": best and with_error(best), "confirmed": confirmed and with_error(confirmed),
    }  # fmt: skip
    judged = confirmed or best
    word = score_word_of_run(run.settings.task, request.folder / BUNDLE)
    score = f"; {describe_score(in_values(judged, run.settings.task), word)}" if judged else ""
    if ended is None:
        with open_run(request.runs_dir, request.name) as stored:
            stored.history()  # `JournalError`: what cannot be read cannot be continued
        text = f"left run {request.name} open{score}; continue it with: {again}"
    else:
        where = f"; controller: {controller}" if controller else "; it has no controller yet"
        more = f"; to continue it, widen its limits: {again} --generations 0 --minutes 30" if nothing_new else ""
        if ended.kind is StopKind.ONE_POINT:
            more = f"; a run --from {request.name} with a larger --sigma0 searches on"
        failed = _describe_failures(request, run.history.failed)
        lasted = elapsed_seconds(run.created, datetime.now(UTC).isoformat())
        ago = "" if lasted is None else f" (begun {format_duration(lasted)} ago)"
        text = f"run {request.name} ended after {ended.text}{ago}{score}{where}{failed}{outcome.text or more}"
    if ended is None and not args.json:
        print(text, file=sys.stderr)
    else:
        print_answer(args, text, **facts, **outcome.facts)
