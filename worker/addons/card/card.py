"""A folder that publishes a controller: a card, its scores, pictures and files, and a script without dreamfleet."""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

from dreamfleet.common.addons.evaluation_report import REPORT, EvaluationReport, differing_facts
from dreamfleet.common.artifacts.bundle import MAX_BUNDLE
from dreamfleet.common.errors import DreamfleetError, StoppedError, UsageError
from dreamfleet.common.files.atomic_write import reporting_unwritable_folder
from dreamfleet.common.files.regular_files import read_regular
from dreamfleet.common.host.stop_signals import Stop, never_stop
from dreamfleet.common.printable import one_line
from dreamfleet.common.runs.episode_results import EpisodeResult
from dreamfleet.worker.addons.card import card_page
from dreamfleet.worker.addons.evaluation.agents import make_agent, make_evaluation_spec
from dreamfleet.worker.addons.evaluation.evaluation import facts_of
from dreamfleet.worker.addons.evaluation.known_score import KnownScore, first_seed, median_drive
from dreamfleet.worker.addons.recording.verb import is_cut
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.registry import find_scored_task, task_of


def write_card(
    contents: card_page.CardContents, folder: Path, steps: int, on_step: Callable[[int], None] = lambda _steps: None,
    stop: Stop = never_stop,
) -> list[str]:  # fmt: skip
    """Write the folder with a video of `steps` at most, 0: none; return the names of its files.

    What the controller or this host cannot give is left out, and `contents.missing` says why. `UsageError` for a folder
    in use, or a report of another controller or world; `StoppedError` if `stop()` turned true while the video was made.
    """
    controller, report = contents.controller, contents.report
    if report is not None:
        _check_report(report, contents)
    with reporting_unwritable_folder(folder, "choose another --out"):
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise UsageError(f"{folder} holds files: choose an empty --out")
        controller.save(folder / card_page.CONTROLLER)
        if contents.bundle is not None:
            (folder / card_page.BUNDLE).write_bytes(read_regular(contents.bundle.path, MAX_BUNDLE))
            _try(contents, card_page.DRIVER, lambda: _write_driver(contents, folder / card_page.DRIVER))
        _try(contents, card_page.SCRIPT, lambda: _write_script(contents, folder))
        if report is not None:
            from dreamfleet.worker.addons.card.score_chart import draw_scores  # matplotlib

            (folder / REPORT).write_text(report.to_json() + "\n")
            (folder / card_page.SCORES).write_bytes(draw_scores(report, contents.name))
        if steps:
            _try(contents, card_page.VIDEO, lambda: _film(contents, folder / card_page.VIDEO, steps, on_step, stop))
        files = sorted(each.name for each in folder.iterdir())
        (folder / card_page.PAGE).write_text("\n".join(card_page.describe_card(contents, files)) + "\n")
    return sorted(each.name for each in folder.iterdir())


def _check_report(report: EvaluationReport, contents: card_page.CardContents) -> None:
    controller = contents.controller
    if report.controller != controller.sha256:
        raise UsageError(
            f"the report is of the controller {report.controller[:12]}, and this is {controller.sha256[:12]}"
        )
    now = facts_of(make_agent(controller, contents.bundle))
    for name in differing_facts(report, now):
        was, found = (one_line(str(each[name])) or "none" for each in (report.facts, now))
        raise UsageError(f"the report says {name} {was}, and it is {found}: write another with `dreamfleet evaluate`")


def _try(contents: card_page.CardContents, name: str, write: Callable[[], None]) -> None:
    try:
        write()
    except StoppedError:
        raise
    except DreamfleetError as error:
        contents.missing[name] = str(error)


def _write_driver(contents: card_page.CardContents, path: Path) -> None:
    from dreamfleet.worker.addons.card.driver_graph import export_driver, largest_difference  # the package onnx

    assert contents.bundle is not None
    graph = export_driver(contents.bundle, contents.controller)
    path.write_bytes(graph)
    contents.difference = largest_difference(contents.bundle, contents.controller, graph)


def _write_script(contents: card_page.CardContents, folder: Path) -> None:
    controller, bundle = contents.controller, contents.bundle
    if bundle is not None and contents.difference is None:
        return
    make_agent(controller, bundle)  # trusts the module of an own run
    task = find_scored_task(controller.task, None) if bundle is None else task_of(bundle)
    script = task.find_standalone_script(Assignment(make_evaluation_spec(controller, bundle), bundle))
    if script is None:
        raise UsageError("no program of one file drives with such observations or actions")
    contents.install = card_page.read_install_command(script)
    shutil.copyfile(script, folder / card_page.SCRIPT)


def _film(contents: card_page.CardContents, path: Path, steps: int, on_step: Callable[[int], None], stop: Stop) -> None:
    from dreamfleet.worker.addons.recording.recording import record, record_in_process  # PyAV

    agent = make_agent(contents.controller, contents.bundle)
    seed, most = seed_to_film(contents.report, agent.known_score), min(steps, agent.world.horizon)
    film = partial(record, agent, steps=most)
    score, driven = record_in_process(film, seed, path, on_step, stop)
    if stop():
        raise StoppedError(f"stopped: {path.parent} is no whole card; delete it, and the same command writes it anew")
    contents.filmed = EpisodeResult(seed, score, driven)
    contents.is_cut = is_cut(driven, most, agent.world.horizon)


def seed_to_film(report: EvaluationReport | None, known: KnownScore | None) -> int:
    """The seed of the report's median drive; without a report, of the median that is known of it."""
    if report is None:
        return first_seed(known)
    return median_drive({each.seed: each.score for each in report.drives})[0]
