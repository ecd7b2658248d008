"""The demonstration: a coordinator and one worker per core on this machine, as a person would start them.

Two runs: one in the dream, and one in reality from the dream's best mean. It starts coordinator and workers as
processes and watches over Zenoh. It judges and records by the worker's functions.

Pages: dashboard.md, README.md, measurements.md.
"""

import math
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from statistics import fmean
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

from dreamfleet.common.artifacts.bundle_store import INT8_SUFFIX, pretrained_folder
from dreamfleet.common.artifacts.driving import FIRST_WORLD
from dreamfleet.common.cli.config import option
from dreamfleet.common.cli.output import print_rows
from dreamfleet.common.cli.progress import LOG_INTERVAL, progress_bar
from dreamfleet.common.client.client import Client
from dreamfleet.common.client.run_view import LiveRunView
from dreamfleet.common.errors import ConnectionFailedError, DreamfleetError, UsageError
from dreamfleet.common.files.regular_files import is_file, path_exists
from dreamfleet.common.host.processes import VerbProcess, shell_command
from dreamfleet.common.host.reports import ADDRESS
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.host.stop_signals import never_stop
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.keys import check_run_name
from dreamfleet.common.runs.lookup import SUBSPACES
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_paths import CONTROLLER, JOURNAL, resume_command, run_command
from dreamfleet.common.runs.seeds import TEST
from dreamfleet.common.runs.standard_error import format_with_error, standard_error
from dreamfleet.common.worlds.profile import DemoPlan
from dreamfleet.common.worlds.score_words import profile_of
from dreamfleet.common.worlds.shipped import WORLDS
from dreamfleet.coordinator.addons.status.status_panel import RunPanel
from dreamfleet.coordinator.settings.config import NO_SUBSPACE
from dreamfleet.experiments.local import command_lines
from dreamfleet.experiments.local.local_run import START_SECONDS, LocalRun, has_begun
from dreamfleet.worker.addons.evaluation.known_score import median_drive

REFRESH = 0.5
PAGE_PACKAGES = ("plotly", "starlette", "uvicorn")
PLOT, VIDEO, SCHEDULE = "fitness.png", "drive.mp4", "stages.toml"
SUBSPACE_SIGMA0, FULL_SIGMA0 = 0.3, 0.1  # first step sizes from zero: in a subspace, and of all parameters
SUBSPACE_SIGMA0_AFTER_DREAM, FULL_SIGMA0_AFTER_DREAM = 0.15, 0.06  # the same after a dream
LATE_SIGMA0 = 0.06  # step size in a subspace once a mean is able
PLANS: dict[str, DemoPlan] = {name: world.demo for name, world in WORLDS.items() if world.demo}


def _option_of_plan(name: str, text: str) -> Any:
    """An option whose default is that of the world's plan."""
    values = {world: f"{getattr(plan, name)}" for world, plan in PLANS.items()}
    each = [f"{value} in {world}" for world, value in values.items()]
    shown = ", ".join(each if len(set(values.values())) > 1 else [*values.values()][:1])
    return option(None, f"{text} (default {shown})")


@dataclass(frozen=True)
class DemoConfig:
    """How long and how large; the defaults suit two cores."""

    world: str = option(FIRST_WORLD, f"the world: {', '.join(PLANS)}")
    dream_minutes: float | None = _option_of_plan("dream_minutes", "dream for so long first; 0: not at all")
    minutes: float | None = _option_of_plan("minutes", "then evolve in reality for so long; 0: not at all")
    temperature: float | None = _option_of_plan("temperature", "of the dream")
    population: int | None = _option_of_plan("population", "candidates a generation in reality")
    episodes: int | None = _option_of_plan("episodes", "episodes a candidate in reality, one until a mean is able")
    horizon: int | None = _option_of_plan("horizon", "steps of an episode at most in reality")
    patience: int | None = _option_of_plan("patience", "steps without reward that end an episode in reality; 0: never")
    sigma0: float | None = option(
        None,
        f"first step size from zero (default {SUBSPACE_SIGMA0} in a subspace, else {FULL_SIGMA0}); "
        f"after a dream {SUBSPACE_SIGMA0_AFTER_DREAM} and {FULL_SIGMA0_AFTER_DREAM}",
    )
    bundle: str | None = _option_of_plan("bundle", "the frozen world model: a shipped name or a file")
    subspace: str | None = option(
        None, "the few features that both searches keep to; none: all parameters (default the bundle's, if one ships)"
    )
    seed: int = option(1, "makes the runs")
    tracks: int | None = _option_of_plan("tracks", "unseen tracks or games that the outcome is judged on")
    workers: int = option(0, "worker processes; 0: one a core")
    port: int = option(7447, "port of the embedded router")
    page: bool = option(
        True, "serve a web page about the runs while they go on, on this computer alone; it needs the extra `dashboard`"
    )

    def __post_init__(self) -> None:
        plan = self.plan
        if min(plan.minutes, plan.dream_minutes) < 0 or plan.tracks < 1 or self.workers < 0:
            raise UsageError("--minutes and --workers must not be negative, --tracks at least 1")
        if not plan.minutes and not plan.dream_minutes:
            raise UsageError("--minutes and --dream-minutes cannot both be 0: nothing would evolve")

    @property
    def plan(self) -> DemoPlan:
        """The world's plan with what is given here; `UsageError` for a world without one."""
        if self.world not in PLANS:
            raise UsageError(f"--world must be one of {', '.join(PLANS)}, not {self.world!r}")
        names = {each.name for each in fields(DemoPlan)}
        given = {name: value for name, value in vars(self).items() if name in names and value is not None}
        return replace(PLANS[self.world], **given)


@dataclass(frozen=True)
class DemoRun:
    """One of the demonstration's runs."""

    run: str
    where: str  # its controller evolved
    what: str
    flags: Mapping[str, object]
    schedule: str = ""  # TOML


class Demo:
    """One demonstration run in `runs_dir`."""

    def __init__(self, config: DemoConfig, name: str, runs_dir: Path) -> None:
        self._config, self._plan, self._profile = config, config.plan, profile_of(config.world)
        self._runs_dir = runs_dir
        self._demo_runs = plan_runs(config, name, runs_dir)
        self._endpoint = f"tcp/127.0.0.1:{config.port}"
        self._console = Console()
        self._next_line = 0.0  # when a line may say how a run goes, where no panel can be drawn

    def play(self) -> None:
        """Evolve, judge, plot, record, and print what to try next; `UsageError` if a run of that name exists."""
        for name in (each.run for each in self._demo_runs):
            if has_begun(self._runs_dir, name):
                delete = run_command(self._runs_dir / name, "runs", "delete")
                raise UsageError(f"run {name} exists: give another --run; `{delete}` removes it")
        with ExitStack() as stack:
            self._show_page(stack)
            for demo_run in self._demo_runs:
                self._evolve(demo_run)
        drives = {each.run: self._judge(each) for each in self._demo_runs}
        self._print_scores(drives)
        for demo_run in self._demo_runs:
            self._plot(demo_run)
        best = max(reversed(self._demo_runs), key=self._confirmed)  # of equals the last
        folder = self._runs_dir / best.run
        controller = folder / CONTROLLER
        seed, score = median_drive(drives[best.run])
        why = " (the higher confirmed score)" if len(drives) > 1 else ""
        what = f"{self._profile.score_word} {seed}, its median: {self._profile.format_score(score)}"
        self._print(f"recording run {best.run}'s controller{why} on {what}")
        self._record(controller, seed, folder / VIDEO)
        self._print_next_steps(folder)

    @property
    def stopped_text(self) -> str:
        """What is kept of a demonstration that was stopped, and the command that continues it."""
        kept = [each.run for each in self._demo_runs if path_exists(self._runs_dir / each.run / JOURNAL)]
        ended = "stopped: all its processes have ended"
        if not kept:
            return f"{ended}, and no run had begun"
        folder = self._runs_dir / kept[-1]
        with open_run(self._runs_dir, kept[-1]) as run:
            if run.ended is None:
                return f"{ended}; run {kept[-1]} is kept: continue it with: {resume_command(folder)}"
        score = shell_command("evaluate", "--controller", folder / CONTROLLER)
        return f"{ended}; run {kept[-1]} had ended; score its controller with: {score}"

    def _show_page(self, stack: ExitStack) -> None:
        """Serve a page about the runs until `stack` closes; none without its packages or a free port."""
        if not self._config.page or any(find_spec(package) is None for package in PAGE_PACKAGES):
            return
        where = ("--connect", self._endpoint, "--runs-dir", self._runs_dir)
        page = stack.enter_context(
            VerbProcess("dashboard", *where, "--host", "127.0.0.1", "--port", 0, ends_with_parent=True)
        )
        with suppress(DreamfleetError):
            self._print(f"the dashboard is at {page.wait_for_report(ADDRESS, START_SECONDS)}")

    def _confirmed(self, demo_run: DemoRun) -> float:
        """A stage's confirmed score: in reality, on fresh tracks that are the same in every stage."""
        with open_run(self._runs_dir, demo_run.run) as run:
            found = run.confirmation()
        return -math.inf if found is None else found.mean

    def _judge(self, demo_run: DemoRun) -> dict[int, float]:
        """Score by track, on tracks that no part of the demonstration has seen."""
        seeds = plural(self._plan.tracks, f"unseen {self._profile.score_word}")
        self._print(f"judging run {demo_run.run}'s controller on {seeds}, in {self._plan.judge}")
        controller = self._runs_dir / demo_run.run / CONTROLLER
        from dreamfleet.worker.addons.evaluation.evaluation import judge
        from dreamfleet.worker.addons.evaluation.named_agents import find_driver

        tracks = tuple(range(TEST.start, TEST.start + self._plan.tracks))
        report = judge(str(controller), find_driver(str(controller), self._runs_dir), tracks, usable_cores())
        return {each.seed: each.score for each in report.drives}

    def _record(self, controller: Path, seed: int, video: Path) -> None:
        from dreamfleet.worker.addons.evaluation.named_agents import find_driver
        from dreamfleet.worker.addons.recording.parallel_dream import ParallelDreamConfig
        from dreamfleet.worker.addons.recording.recording import record, record_in_process

        agent, steps = find_driver(str(controller), self._runs_dir), self._plan.video_steps
        film = partial(record, agent, steps=steps, dreaming=ParallelDreamConfig())
        with progress_bar("record", min(steps, agent.world.horizon), "steps") as bar:
            score, driven = record_in_process(film, seed, video, bar.update, never_stop)
            bar.end(driven)
        words = f"{video}: {self._profile.format_score(score)} on {self._profile.score_word} {seed}"
        self._console.print(words, markup=False)

    def _print_scores(self, drives: Mapping[str, Mapping[int, float]]) -> None:
        """Print a row for each controller: where it evolved, its confirmed score, and that on unseen tracks."""
        word, random = self._profile.score_word, self._plan.random_score
        rows = []
        for demo_run in self._demo_runs:
            with open_run(self._runs_dir, demo_run.run) as run:
                confirmed = run.confirmation()
            scores = list(drives[demo_run.run].values())
            row = {
                "run": demo_run.run,
                "evolved in": demo_run.where,
                f"confirmed on fresh {word}s": None
                if confirmed is None
                else f"{format_with_error(confirmed.mean, confirmed.error)} ({confirmed.episodes})",
                f"on unseen {word}s": f"{format_with_error(fmean(scores), standard_error(scores))} ({len(scores)})",
            }
            rows.append(row if random is None else {**row, "times random play": f"{fmean(scores) / random:.1f}"})
        beside = "" if random is None else f"; random play has {random:zg}"
        self._print(f"means of {self._profile.score_label} ± standard error (number of {word}s){beside}:")
        print_rows(rows, right=tuple(rows[0])[2:])

    def _evolve(self, demo_run: DemoRun) -> None:
        workers, logs, flags = self._config.workers or usable_cores(), self._runs_dir / demo_run.run, demo_run.flags
        self._print(f"{demo_run.what}: a coordinator and {plural(workers, 'worker')} on this machine")
        if demo_run.schedule:
            logs.mkdir(parents=True, exist_ok=True)
            (logs / SCHEDULE).write_text(demo_run.schedule, encoding="utf-8")
            flags = {**flags, "schedule": logs / SCHEDULE}
        settings = command_lines.options(**flags, bundle=self._plan.bundle)
        words = command_lines.begin_run(demo_run.run, self._runs_dir, (self._endpoint,), *settings, as_json=False)
        with LocalRun(demo_run.run, words, logs) as run, run.connect(self._endpoint) as client:
            for name in (f"core-{number}" for number in range(workers)):
                run.start_worker(name, command_lines.worker(demo_run.run, self._endpoint, 1, "--name", name))
            with Live(console=self._console, refresh_per_second=4) as live:

                def look() -> None:
                    run.check_workers()
                    self._show(live, client, demo_run.run)

                run.wait(never_stop, look, REFRESH)
            if not self._console.is_terminal:
                self._console.print()  # the panel's last line has no end there

    def _show(self, live: Live, client: Client, run: str) -> None:
        with suppress(ConnectionFailedError):  # the coordinator is starting, or has just ended
            status = client.status(run)
            live.update(RunPanel(status, client.worker_flags, fitted=self._console.is_terminal))
            if not self._console.is_terminal and time.monotonic() >= self._next_line and not status.is_over:
                self._next_line = time.monotonic() + LOG_INTERVAL
                self._print(f"  {LiveRunView.of_status(status).summary}")

    def _plot(self, demo_run: DemoRun) -> None:
        from dreamfleet.coordinator.addons.runs.plot import fitness_figure, save_figure

        path = self._runs_dir / demo_run.run / PLOT
        with open_run(self._runs_dir, demo_run.run) as run:
            save_figure(fitness_figure(run), path)
        self._console.print(f"{path}: fitness over generations", markup=False)

    def _print_next_steps(self, folder: Path) -> None:
        controller, mine = folder / CONTROLLER, ("--run", "mine", "--preset", self._plan.preset)
        files = f": the controller, {PLOT}, {VIDEO}, the journal. Three things to try:"
        self._console.print(Text.assemble("\n", (f"In {folder}", "bold"), files))
        for command in (
            run_command(folder, "verify", "candidate", more=("--candidate", "0/0")),
            shell_command("evaluate", "--controller", controller, "--episodes", 100),
            shell_command("coordinator", *mine, "--bundle", self._plan.bundle, "--listen", self._endpoint)
            + f"   # and beside it: {shell_command('worker', '--connect', self._endpoint)}",
        ):
            self._console.print(f"  {command}", style="green", highlight=False, soft_wrap=True, markup=False)

    def _print(self, text: str) -> None:
        self._console.print(text, style="bold", markup=False, highlight=False, soft_wrap=True)


def _shipped_subspace_name(bundle: str) -> str | None:
    """The name of the shipped subspace for a shipped world model, of eight bits too; `None` if there is none."""
    name = bundle.removesuffix(INT8_SUFFIX)
    return name if is_file(pretrained_folder() / SUBSPACES / f"{name}.npz") else None


def _evaluation_flags(every: int, tracks: int, confirming: int) -> dict[str, object]:
    return {"evaluate-every": every, "evaluation-episodes": tracks, "confirm-episodes": confirming}


def plan_runs(config: DemoConfig, name: str, runs_dir: Path) -> tuple[DemoRun, ...]:
    """The demonstration's runs, in order."""
    found, plan = [], config.plan
    subspace = (_shipped_subspace_name(plan.bundle) or NO_SUBSPACE) if config.subspace is None else config.subspace
    few = subspace != NO_SUBSPACE
    search: dict[str, object] = {"subspace": subspace, "covariance": "full"} if few else {}
    sigma0 = (SUBSPACE_SIGMA0 if few else FULL_SIGMA0) if config.sigma0 is None else config.sigma0
    reality: dict[str, object] = {
        **search, "population": plan.population, "horizon": plan.horizon,
        "patience": plan.patience, "sigma0": sigma0, "seed": config.seed, "minutes": plan.minutes,
        "variant": plan.variant or None, **_evaluation_flags(*plan.real_evaluations),
    }  # fmt: skip
    if plan.dream_minutes:
        dream = check_run_name(f"{name}-dream")
        flags = {
            **search, "preset": plan.preset, "temperature": plan.temperature, "sigma0": sigma0, "seed": config.seed,
            "minutes": plan.dream_minutes, **_evaluation_flags(*plan.dream_evaluations),
        }  # fmt: skip
        found.append(
            DemoRun(dream, "the dream", f"evolving in the dream for {plural(plan.dream_minutes, 'minute')}", flags)
        )
        reality |= {
            "init": runs_dir / dream / CONTROLLER,
            "sigma0": SUBSPACE_SIGMA0_AFTER_DREAM if few else FULL_SIGMA0_AFTER_DREAM,
        }
    if plan.minutes:
        schedule = (
            f"[[stage]]\nscore = {plan.able_score}\nsteps = {plan.quick_steps}\nepisodes = 1\n\n"
            f"[[stage]]\nepisodes = {plan.episodes}\n" + (f"sigma0 = {LATE_SIGMA0}\n" if few else "")
        )
        where = "the dream, then reality" if plan.dream_minutes else "reality"
        found.append(
            DemoRun(name, where, f"evolving in reality for {plural(plan.minutes, 'minute')}", reality, schedule)
        )
    return tuple(found)
