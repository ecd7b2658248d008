"""Evaluation results: statistics, reports, comparison and reproduction.
Tests lookup.py, paired_difference.py, standard_error.py and worker/addons/verification/reproduction.py."""

import json
import re
import shlex
import shutil
from dataclasses import asdict, replace
from math import sqrt
from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.addons.evaluation_report import MAX_FIGURES, MAX_MARKS, EvaluationReport, read_evaluation_report
from dreamfleet.common.artifacts.bundle_store import find_bundle, pretrained_folder
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.cli import command_line
from dreamfleet.common.errors import ConnectionFailedError, ControllerError, DreamfleetError, UsageError
from dreamfleet.common.protocol.check_counts import CheckCounts
from dreamfleet.common.runs import lookup
from dreamfleet.common.runs.effort import Effort
from dreamfleet.common.runs.episode_results import EpisodeResult, EpisodeResults, FailedEpisode
from dreamfleet.common.runs.lookup import find_controller, find_subspace, naming_the_stored_run
from dreamfleet.common.runs.paired_difference import PairedDifference
from dreamfleet.common.runs.records import StoredConfirmation, StoredEvaluation, describe_score, format_mean, with_error
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.common.runs.run_provenance import RunProvenance, read_run_provenance
from dreamfleet.common.runs.standard_error import format_with_error, sample_std, standard_error
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.coordinator.addons.runs.stored_run import open_run
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.worker.addons.verification.reproduction import Reproduction
from tests.support.journals import confirm
from tests.support.processes import call_here, printed

DRIVES = (
    EpisodeResult(10_000, 850.0, 1000, False, 50.0, 0.0),
    EpisodeResult(10_001, 910.0, 500, True, 80.0, 0.3),
    EpisodeResult(10_002, 250.0, 500, False, 60.0, 0.1),
)
JUDGEMENT = EvaluationReport(
    "tiny", "cd" * 32, "dream", "car-racing", "ab" * 32, "x86_64 avx2", "0.1.0", 12.5, DRIVES, marks=(800.0, 900.0)
)


BROKEN = FailedEpisode(10_007, "ValueError: no road")


def scored(*scores, first=10_000, **others):
    """A report of an environment that reports only scores."""
    drives = tuple(EpisodeResult(seed, float(score), 10) for seed, score in enumerate(scores, first))
    return replace(JUDGEMENT, drives=drives, **{"marks": (), **others})


def test_statistics_weight_episodes_by_their_steps():
    found = EpisodeResults.of(reversed(DRIVES))
    assert found.seeds == (10_000, 10_001, 10_002)
    assert (found.mean, found.median, found.worst, found.best) == (670.0, 850.0, 250.0, 910.0)
    assert found.std == pytest.approx(np.std(found.scores, ddof=1))
    assert found.error == pytest.approx(np.std(found.scores, ddof=1) / np.sqrt(3))
    assert (found.above(800), found.above(910), found.steps, found.finished) == (2 / 3, 0.0, 2000, 1)
    assert (found.speed, found.braking) == (pytest.approx(60.0), pytest.approx(0.1))
    found = scored(1.0).results  # an environment that does not report them
    assert (found.finished, found.speed, found.braking, found.error) == (None, None, None, None)
    for absent in ("laps", "±"):
        assert absent not in scored(1.0).describe()


@pytest.mark.parametrize(
    ("mean", "count", "figures"),
    [
        (900, 100, r"^(?!.*\d\.\d).* 900$"),
        (896, 100, r"4\.0 below .*900$"),
        (905, 99, r"5\.0 above .*900.* 100 seed"),
        (800, 2, r"100\.0 below .*900.* 100 seed"),
    ],
)
def test_the_description_says_whether_the_environment_is_solved(mean, count, figures):
    assert re.search(figures, scored(*[mean] * count, threshold=900.0).describe().splitlines()[1])
    assert "threshold" not in scored(*[mean] * count).describe(), "where gymnasium names none"
    failed = scored(*[mean] * count, threshold=mean - 10.0, failed=(BROKEN,))  # on a seed: it is not solved
    assert re.search(rf"10\.0 .*{mean - 10}", failed.describe())


def test_a_report_round_trips_with_its_statistics_and_describes_driving_and_origin(tmp_path):
    path = tmp_path / "report.json"
    path.write_text(JUDGEMENT.to_json())
    plain = json.loads(path.read_text())
    assert read_evaluation_report(path) == JUDGEMENT
    assert {"mean", "std", "scores", "seeds", "task", "bundle", "judge"} < plain.keys(), "as ever"
    assert (plain["n"], plain["above_900"], plain["finished"], plain["controller"]) == (3, 1 / 3, 1, "cd" * 32)
    assert plain["drives"][1]["steps"] == 500
    score, manner, origin = JUDGEMENT.describe().splitlines()
    assert re.search(r"670\.0 ± 210\.7.* 3 .*250\.0.* 910\.0.* 850\.0", score)
    assert re.search(r"800: 67%.* 900: 33%.* 1 of 3.* 60\.0.* 10%", manner)
    assert re.search(f"2,000.* 12.* {'cd' * 6}.* {'ab' * 6}", origin)


def test_failed_episodes_count_in_no_figure_and_round_trip(tmp_path):
    found = EpisodeResults.of([BROKEN, *DRIVES])
    assert (found.mean, found.seeds, found.failed) == (670.0, (10_000, 10_001, 10_002), (BROKEN,))
    report = replace(JUDGEMENT, failed=(BROKEN,))
    assert "seed 10007, ValueError: no road" in report.describe()
    (tmp_path / "report.json").write_text(report.to_json())
    assert read_evaluation_report(tmp_path / "report.json") == report
    with pytest.raises(DreamfleetError, match="seed 10007, ValueError: no road"):
        EpisodeResults.of([BROKEN])


@pytest.mark.parametrize(
    "text",
    [
        "", "[]", "{}", '{"drives": []}', JUDGEMENT.to_json().replace("910.0", '"910"'),
        JUDGEMENT.to_json().replace("910.0", "1e308"), JUDGEMENT.to_json().replace("910.0", "NaN"),
        JUDGEMENT.to_json().replace("10001", "10000"),  # a seed twice
        *(replace(JUDGEMENT, options=text).to_json() for text in ("not json", "[1]", "1", "null", "[" * 100_000)),
    ],
)  # fmt: skip
def test_an_invalid_report_is_a_one_line_error(tmp_path, text):
    path = tmp_path / "report.json"
    path.write_text(text)
    with pytest.raises(UsageError, match=re.escape(str(path))):
        read_evaluation_report(path)
    with pytest.raises(UsageError, match=r"nowhere\.json"):
        read_evaluation_report(tmp_path / "nowhere.json")


@pytest.mark.parametrize(("name", "stated"), [
    ("n", 1000), ("mean", 671.0), ("mean", None), ("mean", "670"), ("mean", 10**400), ("std", 1.0), ("error", 0.3),
    ("median", 900.0), ("least", 700.0), ("most", 930.0), ("steps", 1), ("finished", 3), ("speed", 99.0),
    ("braking", 0.9), ("above_900", 1.0), ("above_950", 0.9), ("above_x", 1.0), ("scores", [670.0] * 3),
    ("scores", 670.0), ("seeds", [1, 2, 3]),
])  # fmt: skip
def test_a_report_whose_figures_are_not_its_drives_is_refused(tmp_path, name, stated):
    path = tmp_path / "report.json"
    path.write_text(json.dumps({**json.loads(JUDGEMENT.to_json()), name: stated}))
    if stated is None:  # states nothing
        assert read_evaluation_report(path) == JUDGEMENT
        return
    with pytest.raises(UsageError, match=re.escape(str(path))):
        read_evaluation_report(path)


def test_a_report_may_leave_out_its_marks_and_the_last_bits_of_a_mean(tmp_path):
    plain = json.loads(JUDGEMENT.to_json())
    del plain["marks"]
    plain |= {"mean": np.nextafter(plain["mean"], 0.0)}
    (tmp_path / "report.json").write_text(json.dumps(plain))
    assert read_evaluation_report(tmp_path / "report.json") == replace(JUDGEMENT, marks=())


BLIND = replace(JUDGEMENT, hidden=DRIVES[:2], hidden_failed=(FailedEpisode(10_002, "E: x"),), foreign=DRIVES[1:])


def test_a_blind_pass_is_over_the_seeds_of_all_passes_and_its_failures_stay(tmp_path):
    (tmp_path / "report.json").write_text(BLIND.to_json())
    assert read_evaluation_report(tmp_path / "report.json") == BLIND
    assert [BLIND.figures[f"hidden_{name}"] for name in ("n", "mean", "loss", "loss_error")] == [1, 910.0, 0.0, None]
    assert "10002, E: x" in BLIND.describe()
    dark = replace(BLIND, hidden=(), hidden_failed=tuple(FailedEpisode(each.seed, "E: x") for each in DRIVES))
    assert (dark.figures["hidden_n"], dark.figures["foreign_n"]) == (None, 2), "a pass without any score bars no other"
    assert "10000, E: x" in dark.describe()
    without = replace(JUDGEMENT, failed=(BROKEN,), hidden=(replace(DRIVES[0], seed=BROKEN.seed),))
    (tmp_path / "report.json").write_text(without.to_json())  # only blind it has a score there
    assert read_evaluation_report(tmp_path / "report.json").figures["hidden_n"] is None


def test_what_was_asked_of_a_blind_pass_needs_a_clear_loss_in_each():
    plain = scored(500, 510, 520)
    passes = {(100, 100, 100): True, (99, 100, 101): True, (99, 100, 99): False, (0, 0, 800): False}
    for losses, sees in passes.items():
        blind = tuple(replace(each, score=each.score - less) for each, less in zip(plain.drives, losses, strict=True))
        report = replace(plain, hidden=blind, foreign=blind, asked_loss=100.0)
        assert (report.sees, report.figures["sees"], report.figures["asked_loss"]) == (sees, sees, 100)
        assert report.describe_sight() in report.describe()
        for one in ({"hidden": ()}, {"foreign": plain.drives}, {"foreign": blind[:1]}):
            assert not replace(report, **one).sees
        assert replace(report, asked_loss=0.0).sees == (losses != (0, 0, 800))
    assert (plain.figures["sees"], plain.figures["asked_loss"]) == (None, None)


@pytest.mark.parametrize("changes", [
    {"asked_loss": 1.0, "sees": True}, {"sees": False}, {"asked_loss": -1.0}, {"asked_loss": float("nan")},
    {"hidden": [replace(DRIVES[0], seed=99)]}, {"foreign": [DRIVES[0]] * 2}, {"hidden_failed": [BROKEN]},
    {"foreign": DRIVES, "foreign_failed": [FailedEpisode(10_000, "E: x")]}, {"hidden_loss": 3.0}, {"foreign_n": 0},
    *({"hidden": [replace(DRIVES[0], score=score)]} for score in (1e101, float("nan"), float("-inf"))),
    *({"drives": [replace(each, figures={"a": figure}) for each in DRIVES]} for figure in (float("nan"), 1.7e308)),
    {"marks": [float("inf")]}, {"threshold": float("nan")}, {"figures": {"turns": 0.3}}, {"figures": 3.0},
])  # fmt: skip
def test_a_report_whose_blind_drives_or_figures_cannot_be_is_refused(tmp_path, changes):
    path = tmp_path / "report.json"
    path.write_text(json.dumps({**json.loads(JUDGEMENT.to_json()), **changes}, default=asdict))
    with pytest.raises(UsageError, match=re.escape(str(path))):
        read_evaluation_report(path)


@pytest.mark.parametrize(("most", "changes"), [
    (MAX_FIGURES, {"drives": [replace(DRIVES[0], figures=dict.fromkeys(map(str, range(100_000)), 1.0))]}),
    (MAX_FIGURES, {"hidden": [replace(each, figures={str(each.seed * 100 + n): 1.0 for n in range(40)})
                              for each in DRIVES]}),
    (MAX_MARKS, {f"above_{mark}": 0.0 for mark in range(1000, 101_000)}),
])  # fmt: skip
def test_a_report_with_more_names_than_a_world_has_is_refused(tmp_path, most, changes):
    path = tmp_path / "report.json"
    path.write_text(json.dumps({**asdict(JUDGEMENT), **changes}, default=asdict))
    with pytest.raises(UsageError, match=f"{re.escape(str(path))}.* {most}"):
        read_evaluation_report(path)


def test_a_difference_is_paired_by_seed_and_significant_above_two_standard_errors():
    found = PairedDifference.between(scored(100, 500, 900).results, scored(110, 512, 908, 0).results)
    assert (found.seeds, found.mean, found.is_significant) == (3, 10.0, True)
    assert found.error == pytest.approx(np.std([10, 12, 8], ddof=1) / np.sqrt(3))
    found = PairedDifference.between(scored(100, 500, 900).results, scored(200, 400, 930).results)
    assert not found.is_significant
    assert re.search(r" 4\.5\b", found.description)
    assert not PairedDifference(30, 1.0, 0.6).is_significant
    bounds = [round(PairedDifference(seeds, 0, 1).critical_value, 2) for seeds in (2, 3, 4, 8, 16)]
    assert bounds == [13.97, 4.53, 3.28, 2.43, 2.18]  # t itself: 13.97, 4.53, 3.31, 2.43, 2.18
    assert "±" not in PairedDifference.between(*[JUDGEMENT.results] * 2).description
    with pytest.raises(UsageError):
        PairedDifference.between(scored(1, 2).results, scored(1, 2, first=10_001).results)


def test_the_verb_compares_each_report_with_the_first(tmp_path, capsys):
    paths = [tmp_path / f"{name}.json" for name in "abc"]
    for path, scores in zip(paths, [(100, 500, 900), (110, 512, 908), (100, 500, 900)], strict=True):
        path.write_text(scored(*scores).to_json())
    assert command_line.main(["compare", *map(str, paths)]) == 0
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 5
    assert said[2].endswith("better")
    assert command_line.main(["compare", *map(str, paths), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["differences"]
    assert [(each["mean"], each["clear"]) for each in rows] == [(10.0, True), (0.0, False)]
    assert command_line.main(["compare", str(paths[0])]) == UsageError.exit_code


@pytest.mark.parametrize(("changes", "differing"), [
    ({"task": "car-racing"}, []),  # a dream's controllers are driven in reality too
    ({"fingerprint": "arm"}, ["fingerprint"]), ({"world": "takecover"}, ["world"]), ({"judge": "dodge"}, ["judge"]),
    ({"options": '{"environment": {"g": 0.12345678901234567}}'}, ["options"]),
])  # fmt: skip
def test_other_differences_than_the_controllers_are_noted(tmp_path, capsys, changes, differing):
    paths = [str(tmp_path / f"{name}.json") for name in "abc"]
    for path, each in zip(paths, [{}, {}, changes], strict=True):
        Path(path).write_text(scored(1, 2, **each).to_json())
    assert command_line.main(["compare", *paths]) == 0
    what, *notes = capsys.readouterr().err.splitlines()
    assert "`evaluate`" in what
    shown = {**changes, "options": "0.123457"}
    assert [paths[2] in each and shown[name] in each for name, each in zip(differing, notes, strict=True)] == (
        [True] * len(differing)
    )
    assert command_line.main(["compare", *paths, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["differences"]
    assert [each["differing_facts"] for each in rows] == [[], differing]
    assert ["clear" in each for each in rows] == [True, "world" not in changes]


def test_scores_of_different_worlds_or_directions_have_no_difference(tmp_path, capsys):
    least = {"task": "function:mine:cost", "options": '{"environment": {"x0": [0], "minimise": true}}'}
    paths = [str(tmp_path / f"{name}.json") for name in "abc"]
    for path, each in zip(paths, [{}, {"first": 50_000, "world": "takecover"}, least], strict=True):
        Path(path).write_text(scored(1, 2, **each).to_json())
    assert command_line.main(["compare", *paths, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["differences"]
    assert [{"clear", "mean", "error", "seeds"} & each.keys() for each in rows] == [set(), set()]


ELSEWHERE, FAILS_NOW = {"fingerprint": "aarch64"}, (FailedEpisode(10_002, "E: x"),)


def test_episodes_that_failed_when_they_were_recorded_are_named_and_not_driven_again():
    recorded = replace(scored(100, 500), failed=(FailedEpisode(10002, "ValueError: sick"),))
    found = Reproduction(recorded, scored(100, 500))
    assert found.is_reproduced
    assert " 1 episode" in found.description


@pytest.mark.parametrize("words", ["--episodes 99999999999", "--first-seed 9223372036854775807"])
def test_seeds_out_of_range_are_refused_before_the_episodes(words, capsys):
    for controller in ("tiny", "random"):
        assert command_line.main(["evaluate", "--controller", controller, *words.split()]) == 2
        assert re.search("--episodes.* 100000", capsys.readouterr().err)


@pytest.mark.parametrize(
    ("scores", "changes", "holds", "figure"),
    [
        ((100, 500, 900), {}, True, "3 bit-identical"),
        ((100, 500, 900), ELSEWHERE, True, "3 bit-identical"),
        ((100, 500, 900.0001), {}, False, "10002"),
        ((110, 480, 900), ELSEWHERE, True, "496.7"),
        ((110, 511, 909), ELSEWHERE, False, "510.0"),
        ((100, 500), {}, True, "2 bit-identical"),
        ((110,), ELSEWHERE, False, "110.0"),  # a single seed has no standard error
        ((100, 500), {"failed": FAILS_NOW}, False, "seed 10002, E: x"),
        ((100, 500), {"failed": FAILS_NOW, **ELSEWHERE}, False, "seed 10002, E: x"),
    ],
)
def test_reproduction_is_to_the_bit_on_equal_hosts_and_within_two_errors_elsewhere(scores, changes, holds, figure):
    found = Reproduction(scored(100, 500, 900), scored(*scores, **changes))
    assert found.is_reproduced == holds
    assert figure in found.description
    assert "tiny" in found.description


@pytest.mark.parametrize(("was", "now", "decided", "holds"), [
    ((100, 180), (500, 500), False, False), ((0, 700), (500, 500), False, False), ((0, 1000), (500, 500), False, False),
    ((500, 480), (500.001, 479.9995), True, True),  # the difference is small
    ((100, 101), (500, 500.9), True, False),
    ((100, 500, 900, 300), (900, 300, 100, 510), False, False),
    (tuple(range(100)), tuple(reversed(range(100))), True, True),
    ((500,) * 100, (*(500,) * 99, 499), True, True),
    ((500, 0, 500, 0, 480, 0, 200, 9, 120, 0), (26, 31, 22, 27, 25, 30, 24, 28, 23, 25), False, False),  # invented
])  # fmt: skip
def test_on_another_host_too_few_seeds_decide_nothing(was, now, decided, holds):
    found = Reproduction(scored(*was), scored(*now, **ELSEWHERE))
    assert (found.is_decided, found.is_reproduced) == (decided, holds)


FACTS = {
    "controller": "ef" * 32, "task": "gym:Acrobot-v1", "options": '{"a": 1}', "world": "gym:Acrobot-v1",
    "judge": "dodge", "bundle": "64" * 32, "threshold": 200.0, "marks": (1.0,),
}  # fmt: skip


@pytest.mark.parametrize("fact", FACTS)
@pytest.mark.parametrize("changes", [{}, ELSEWHERE])
def test_a_record_that_states_another_controller_or_world_is_not_reproduced(fact, changes):
    recorded = scored(100, 500, 900)
    found = Reproduction(replace(recorded, **{fact: FACTS[fact]}), replace(recorded, **changes))
    assert (found.is_reproduced, found.differing_facts) == (False, (fact,))
    assert str(FACTS[fact]) in found.description


def test_what_a_record_leaves_out_contradicts_nothing():
    now = scored(100, 500, 900, options='{"a": 1}', threshold=900.0, marks=(800.0,))
    found = Reproduction(scored(100, 500, 900), now)
    assert (found.is_reproduced, found.differing_facts) == (True, ())


@pytest.mark.parametrize(("was", "now", "holds"), [
    ({}, {"finished": True, "speed": 50.0}, True), ({"finished": True}, {"finished": False}, False),
    ({"finished": False}, {}, False), ({"speed": 50.0}, {"speed": 50.5}, False),
    ({"braking": 0.0}, {"braking": 0.1}, False),
])  # fmt: skip
def test_every_recorded_figure_of_an_episode_must_be_equal_on_equal_hosts(was, now, holds):
    recorded, repeated = (
        replace(JUDGEMENT, drives=(DRIVES[0], EpisodeResult(10_001, 910.0, 500, **each))) for each in (was, now)
    )
    found = Reproduction(recorded, repeated)
    assert (found.is_reproduced, found.differing_seeds) == (holds, () if holds else (10_001,))


def test_a_report_of_another_world_names_its_judge_and_its_marks(tmp_path):
    report = scored(700, 800, threshold=750.0, judge="dodge", marks=(750.0,))
    (tmp_path / "report.json").write_text(report.to_json())
    assert read_evaluation_report(tmp_path / "report.json") == report
    plain = json.loads(report.to_json())
    assert (plain["above_750"], plain["marks"]) == (0.5, [750.0])
    assert "above_800" not in plain
    score, marks, threshold, _ = report.describe().splitlines()
    assert score.endswith("dodge")
    assert "750: 50%" in marks
    assert re.search(r"0\.0 above .*750.* 100 seed", threshold)
    score, _, threshold, _ = report.describe("game").splitlines()
    assert " 2 game" in score
    assert " 100 game" in threshold


def test_a_standard_error_has_the_samples_standard_deviation():
    assert sample_std([1.0, 3.0]) == pytest.approx(sqrt(2))  # with n in the denominator 29 % less
    assert (sample_std([5.0]), standard_error([5.0])) == (None, None)


@pytest.mark.parametrize("episodes", [2, 64])
def test_an_evaluation_and_a_confirmation_of_equal_scores_have_equal_errors(episodes):
    """An evaluation is stored with the population's standard deviation, a confirmation with the sample's."""
    scores = np.random.default_rng(episodes).normal(500, 100, episodes)
    evaluation = StoredEvaluation(1, episodes, float(scores.mean()), float(scores.std()))
    confirmation = StoredConfirmation(1, episodes, float(scores.mean()), float(scores.std(ddof=1)), 2)
    expected = pytest.approx(scores.std(ddof=1) / sqrt(episodes))
    assert (evaluation.error, confirmation.error, standard_error(scores.tolist())) == (expected, expected, expected)


@pytest.mark.parametrize("found", [StoredEvaluation(3, 1, 812.5, 0.0), StoredConfirmation(3, 1, 812.5, 0.0, 4)])
def test_one_episode_has_no_error_wherever_it_is_read(found):
    assert found.error is None
    assert with_error(found)["error"] is None
    assert format_mean(found) == "812.5"
    assert "±" not in describe_score(found)


def test_a_small_score_has_enough_digits_and_a_zero_no_sign():
    shown = {
        "-3.5": (-3.5, None), "0.123 ± 0.003": (0.1234, 0.0031), "0.00042": (0.00042, None), "500.0 ± 0": (500.0, 0.0),
        "0.0 ± 2.0": (-0.01, 2.0), "0.0": (-0.0, None), "812": (812.4, None, 0), "1,234.6 ± 7,890.1": (1234.56, 7890.1),
    }  # fmt: skip
    assert {text: format_with_error(*figures) for text, figures in shown.items()} == {text: text for text in shown}
    assert format_with_error(0.5, 0.25, 2, sign="+") == "+0.50 ± 0.25"


def test_a_subspace_is_a_shipped_one_of_a_shipped_world_model_or_a_file(tmp_path, monkeypatch):
    for path in (pretrained_folder() / lookup.SUBSPACES).glob("*.npz"):
        owner = find_bundle("tiny" if path.stem == "real" else path.stem)
        assert find_subspace(path.stem).bundle == owner.sha256
    subspace = Subspace(np.ones((2, 5), np.float32), np.zeros(2, np.float32), ("a", "b"), "ab" * 32)
    monkeypatch.setattr(lookup, "pretrained_folder", lambda: tmp_path / "ships")
    (tmp_path / "ships" / lookup.SUBSPACES).mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=r"'tiny'.* .?none"):
        find_subspace("tiny")
    subspace.save(tmp_path / "ships" / lookup.SUBSPACES / "tiny.npz", {})
    assert find_subspace("tiny").sha256 == subspace.sha256
    with pytest.raises(UsageError, match=r"'few\.npz'.* .?tiny"):
        find_subspace("few.npz")
    subspace.save(tmp_path / "few.npz", {})
    assert find_subspace("few.npz").sha256 == subspace.sha256
    (tmp_path / "broken.npz").write_text("rubbish")
    with pytest.raises(UsageError, match=r"broken\.npz"):
        find_subspace("broken.npz")


@pytest.mark.wording
def test_where_no_coordinator_answers_the_stored_run_is_named(tmp_path, random_bundle):
    def refused(name):
        with pytest.raises(ConnectionFailedError) as caught, naming_the_stored_run(tmp_path, name):
            raise ConnectionFailedError("no one answers")
        return str(caught.value)

    assert refused("night") == refused(None) == "no one answers"
    (tmp_path / "night").mkdir()
    journal = Journal.create(tmp_path / "night", freeze(RunConfig(), random_bundle), random_bundle.path)
    assert re.search("night.* coordinator --resume night", refused("night"))
    journal.set_fact("ended", "3 generations")
    journal.commit()
    journal.close()
    assert re.search("night .*3 generations", refused("night"))
    assert shlex.split(refused(None).split("`")[1])[1:] == ["runs", "list", "--runs-dir", str(tmp_path)]


def test_a_controller_that_lags_behind_the_journal_is_the_one_that_the_journal_reports(runs):
    written = Controller.load(runs / "reality" / CONTROLLER)
    receipt = RunProvenance(1, Effort(), checks=CheckCounts(0.0, barred=("let in again since",)))
    facts = {"generation": 0, "receipt": to_plain(receipt)}
    old = replace(written, parameters=written.parameters + 1, provenance=written.provenance | facts)
    old.save(runs / "reality" / CONTROLLER)
    for name, folder in (("reality", runs), (str(runs / "reality"), runs / "elsewhere")):
        found, _ = find_controller(name, folder)
        assert (found.sha256, found.provenance | written.provenance) == (written.sha256, found.provenance)
        assert read_run_provenance(found).checks is None
    with open_run("reality", runs) as run:
        assert run.controller().sha256 == written.sha256
    assert json.loads(printed("runs", "receipt", "reality", "--json"))["controller"] == written.sha256
    printed("runs", "backup", "reality", "--to", runs / "safe")
    assert Controller.load(runs / "safe" / "reality" / CONTROLLER).sha256 == written.sha256


def test_a_confirmed_mean_goes_before_the_best_evaluated_one(runs):
    with open_run("reality", runs) as run:
        generation, closed = min(each.generation for each in run.evaluations()), len(run.history())
        vector = run.evaluated_mean(generation)
    confirm(runs / "reality", generation, 4, 2.5, 0.5, closed)
    found, _ = find_controller("reality", runs)
    assert (found.parameters == vector).all()
    named = [found.provenance[each] for each in ("generation", "validation_mean", "confirmed")]
    assert named == [generation, 2.5, True]


def test_another_runs_controller_is_refused(runs):
    shutil.copyfile(runs / "hidden" / CONTROLLER, runs / "reality" / CONTROLLER)
    with pytest.raises(ControllerError, match="reality"):
        find_controller("reality", runs)
    assert call_here("runs", "receipt", "reality")[0] == 1
    printed("runs", "backup", "reality", "--to", runs / "safe")
    with pytest.raises(ControllerError, match="reality"):
        find_controller("reality", runs / "safe")
