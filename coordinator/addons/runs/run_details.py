"""A stored run in rows and facts, for people and for programs: what `runs list`, `runs show` and the page render.

Pages: quality-diversity.md, own-objective.md, trust.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.addons.analysis.run_archive import RunArchive
from dreamfleet.common.addons.analysis.scored_history import scored_history
from dreamfleet.common.addons.evaluation_report import REPORT, EvaluationReport, read_evaluation_report
from dreamfleet.common.artifacts.objective import Objective
from dreamfleet.common.client.equal_fitness import EqualFitness
from dreamfleet.common.client.run_view import RunView
from dreamfleet.common.errors import DreamfleetError, JournalError
from dreamfleet.common.printable import format_duration, format_number, format_setting, plural
from dreamfleet.common.protocol.function_values import value_of
from dreamfleet.common.protocol.tasks import DREAM, is_function_task
from dreamfleet.common.runs.lookup import load_controller_of
from dreamfleet.common.runs.records import (
    RunSettings,
    StoredGeneration,
    best_evaluation,
    in_values,
    with_error,
)
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.stages import BegunStage, begun_stages, stages_of
from dreamfleet.common.worlds.score_words import score_word_of_run
from dreamfleet.coordinator.addons.runs.export import rows_of
from dreamfleet.coordinator.settings.config import DEFAULT_HORIZON, RunConfig

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

ROW = (
    "run", "created", "task", "generations", "mean", "best", "best_error", "confirmed", "confirmed_error", "classes",
    "state", "ended",
)  # fmt: skip
FITNESS = ("mean", "std", "best", "worst")  # of a generation; none where all candidates failed
Setting = tuple[str, str, bool]  # name, value, and whether it differs from its default


def view_of(run: RunFolder) -> RunView:
    """The view of a stored run; `JournalError` if its journal is damaged."""
    history, spec = run.history(), run.spec
    last, best = history[-1] if history else None, best_evaluation(run.evaluations())
    scores = in_values(last, spec), in_values(best, spec), in_values(run.confirmation(), spec)
    return RunView(run.settings, *scores, score_word_of_run(spec, run.bundle_path), run.episode_limit)


def run_row(path: Path, *, as_values: bool) -> dict[str, Any]:
    """A run in a list of runs, with the keys `ROW`: its scores in a function's values, or as fitness.

    A run whose journal is damaged has its name, and the error as its state.
    """
    try:
        with RunFolder(path) as run:
            history, best, confirmed = run.history(), best_evaluation(run.evaluations()), run.confirmation()
            is_scored = bool(history) and history[-1].number not in run.unscored_generations()
            scores: list[float | None] = [history[-1].mean if is_scored else None]
            scores += [each.mean if each else None for each in (best, confirmed)]
            mean, *judged = (each if each is None or not as_values else value_of(each, run.spec) for each in scores)
            found = (
                run.name, run.created, run.spec.task, len(history), mean, judged[0], best and best.error, judged[1],
                confirmed and confirmed.error, run.classes.total, run.state, run.ended is not None,
            )  # fmt: skip
            return dict(zip(ROW, found, strict=True))
    except JournalError as error:
        return {**dict.fromkeys(ROW), "run": path.name, "state": str(error)}


def run_document(run: RunFolder) -> dict[str, Any]:
    """All of a run for programs: facts, settings, generations and evaluations."""
    settings, history, confirmed = run.settings, run.history(), run.confirmation()
    checks, archive, evaluated = run.checks, RunArchive.of(run), find_evaluation(run)
    begun = begun_stages(settings, history, run.evaluations()) if settings.stages else ()
    return {
        **_identity(run),
        "lasted_seconds": run.duration_seconds,
        "failed_candidates": count_failed(history),
        "replaced_seeds": run.count_reseeds(history),
        "equal_generations": _equal_fitness(settings, history).count,
        "settings": asdict(settings),
        "confirmed": None if confirmed is None else with_error(confirmed),
        "history": rows_of(run, "generations"),
        "evaluations": rows_of(run, "evaluations"),
        "stages": [{"number": each.stage.number, "since": each.since, "after": each.why} for each in begun],
        "classes": asdict(run.classes),
        **({} if evaluated is None else {"evaluated": evaluated.figures}),
        **({} if checks is None else {"checks": asdict(checks)}),
        **({} if archive is None else {"archive": archive.facts}),
    }


def find_evaluation(run: RunFolder) -> EvaluationReport | None:
    """What `evaluate --out` wrote into the run's folder of the controller that the run reports now."""
    with suppress(DreamfleetError):
        found = read_evaluation_report(run.path / REPORT)
        return found if found.controller == load_controller_of(run).sha256 else None
    return None


def run_facts(run: RunFolder) -> dict[str, Any]:
    """What a run is and what it came to, in words by name; its settings are in `setting_rows`."""
    settings, history, classes = run.settings, run.history(), run.classes
    facts: dict[str, Any] = _identity(run)
    if run.duration_seconds is not None:
        facts["ended_at"] = f"{run.ended_at}, {format_duration(run.duration_seconds)} after it began"
    facts["failed_candidates"] = describe_failed(settings, history, run.count_reseeds(history))
    if warning := _equal_fitness(settings, history).describe(settings.task):
        facts["warning"] = warning
    facts |= {"hosts": classes.description, **{f"class {name}": hosts for name, hosts in classes.rows}}
    if run.checks is not None:
        facts["checks"] = run.checks.description
    facts["reported"] = view_of(run).score
    if (evaluated := find_evaluation(run)) is not None:
        facts["evaluated"] = "; ".join(evaluated.describe_scores(score_word_of_run(run.spec, run.bundle_path)))
    if (network := run.fact("network")) not in (None, "{}"):  # a resumed run listens where a stranger's journal says
        facts["network"] = network
    if is_function_task(settings.task.task):
        judged = run.reported()
        mean = None if judged is None else run.evaluated_mean(judged.generation)
        facts |= _function_facts(mean, settings.task.options)
    if (archive := RunArchive.of(run)) is not None:
        facts["archive found"] = archive.description
    if settings.stages:
        begun = begun_stages(settings, history, run.evaluations())
        facts |= {"stage": f"{begun[-1].stage.number} of {len(settings.stages)}", **describe_stages(settings, begun)}
    return facts


def count_failed(history: Iterable[StoredGeneration]) -> int:
    """Candidates of closed generations that failed and have no fitness."""
    return sum(each.failed for each in history)


def describe_failed(settings: RunSettings, history: Sequence[StoredGeneration], reseeds: int) -> str:
    """How many candidates failed, the setting that says what becomes of them, and how many sets of seeds failed."""
    found = f"{count_failed(history)} in {plural(len(history), 'closed generation')}"
    found += f" (--on-failure {settings.on_failure})"
    sets = plural(reseeds, "set of seeds", "sets of seeds")
    return f"{found}; {sets} replaced, because all candidates failed" if reseeds else found


def describe_stages(settings: RunSettings, begun: Sequence[BegunStage]) -> dict[str, str]:
    """Describe each stage of a schedule and when it began, by the stage's name."""
    found, first = {}, {each.stage.number: each for each in begun}
    for stage in stages_of(settings) if settings.stages else ():
        if stage.number not in first and stage.number < max(first, default=0):
            found[f"stage {stage.number}"] = "left out"
            continue
        since = first[stage.number].beginning if stage.number in first else "not begun"
        found[f"stage {stage.number}"] = f"{since}, {stage.end_condition}: {stage.description}"
    return found


def _equal_fitness(settings: RunSettings, history: Sequence[StoredGeneration]) -> EqualFitness:
    return EqualFitness(() if settings.is_external else history)  # as `take_snapshot` says of a live one


def _identity(run: RunFolder) -> dict[str, Any]:
    return {
        "run": run.name, "run_uid": run.uid, "created": run.created, "ended": run.ended, "ended_at": run.ended_at,
        "fingerprint": run.fingerprint,
    }  # fmt: skip


def _function_facts(mean: NDArray[np.float32] | None, options: str) -> dict[str, str]:
    """The arguments of a function that the reported mean of its run stands for."""
    objective = Objective.parse(options)
    values = f"the function's own; {'smaller' if objective.minimise else 'larger'} ones are better"
    found = "-" if mean is None else ", ".join(f"{each:z.8g}" for each in objective.decode(mean))
    return {"reported x": found, "values": values}


def setting_rows(settings: RunSettings, plain: Mapping[str, Any], limit: int | None) -> list[Setting]:
    """The settings by dotted name as people read them: those that differ from their default first.

    `plain` are the settings as plain data, in the order and the detail to show; `limit` is the environment's own of an
    episode's steps.
    """
    rows: list[Setting] = []

    def walk(name: str, value: object) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(f"{name}.{key}" if name and key != name else str(key), inner)
        elif isinstance(value, (list, tuple)) and value and isinstance(value[0], dict):
            for number, inner in enumerate(value, 1):
                walk(f"{name}.{number}", inner)
        elif value not in (None, "", ()):
            text = format_setting(value)
            if name == "task.horizon" and limit and limit < settings.task.horizon:
                text += f", but this environment ends an episode after {limit:,} steps"
            rows.append((name, text, _differs(name.removeprefix("task."), value, settings)))

    walk("", plain)
    return sorted(rows, key=lambda each: not each[2])


def _differs(name: str, value: object, settings: RunSettings) -> bool:
    """Whether a setting differs from its default; the task and its options have none."""
    defaults = {each.name: each.default for each in fields(RunConfig) if "record" in each.metadata}
    horizon = 1 if is_function_task(settings.task.task) else DEFAULT_HORIZON
    defaults |= {"horizon": horizon, "confirm_episodes": settings.evaluation_episodes}
    return value != defaults[name] if name in defaults else name.startswith(("options", "stages", "bundle", "subspace"))


def unused_settings(settings: RunSettings) -> set[str]:
    """Names of settings that change nothing in this run, by its task and by what it leaves out."""
    task = settings.task
    unused = {"task.version"} if task.version == 1 else set()
    if not task.bundle:
        unused |= {"features", "collect_every", "collect_episodes", "task.bundle"}
    if task.task != DREAM:
        unused |= {"driven", *(f"task.{name}" for name in ("temperature", "recorded", "driven", "end"))}
    if not settings.evaluate_every:
        unused |= {"evaluation_episodes", "confirm_episodes"}
    if not settings.collect_every:
        unused.add("collect_episodes")
    if settings.optimiser != "cma":
        unused.add("covariance")
    return unused


def generation_rows(run: RunFolder) -> list[dict[str, object]]:
    """A row for each closed generation, with the evaluation of its mean."""
    judged = {each.generation: value_of(each.mean, run.spec) for each in run.evaluations()}
    rows: list[dict[str, object]] = []
    for each in (in_values(closed, run.spec) for closed in scored_history(run)):
        fitness = {"average" if name == "mean" else name: getattr(each, name) for name in FITNESS}
        evaluated = judged.get(each.number)
        rows.append({
            "generation": each.number,
            **{name: format_number(value) for name, value in fitness.items()},
            "sigma": format_number(each.sigma), "failed": each.failed or "", "steps": f"{each.steps:,}",
            "seconds": f"{each.seconds:.1f}", "evaluated": "" if evaluated is None else format_number(evaluated),
        })  # fmt: skip
    return rows
