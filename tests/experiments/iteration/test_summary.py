"""Rounds, described for people and for programs."""

from pathlib import Path

import pytest

from dreamfleet.experiments.iteration import summary
from dreamfleet.experiments.iteration.layout import IterationFolder
from tests.support.ledgers import entry, ledger

QUALITY = {"nats_per_dimension": 0.96, "reward_auc": 0.93}
SCORE = {"mean": 812.4, "error": 15.2, "episodes": 32, "word": "track", "generation": 9, "confirmed": True}
FIGURES = {"knows": {"value": 0.8, "error": 0.01}, "loses": None}
LAYOUT = IterationFolder(Path("data"))


def describe_rounds(*entries):
    return summary.describe_rounds(LAYOUT, ledger(*entries))


FIRST = (
    entry(1, "collect", episodes=620, new=620),
    entry(1, "bundle", frames=153_000, quality=QUALITY, sha256="ab" * 32),
    entry(1, "evolve", score=SCORE),
)
SECOND = (
    entry(2, "drive", episodes=700, new=80),
    entry(2, "bundle", frames=170_000, quality=QUALITY, sha256="cd" * 32),
    entry(2, "gate", kept=False, why="refused", old=FIGURES, new=FIGURES),
)


def test_a_row_per_round_has_drives_model_gate_and_score():
    one, two = summary.table_rows(describe_rounds(*FIRST, *SECOND))
    assert list(one.values()) == [1, 620, 153_000, 0.96, 0.93, None, None, "kept", "812.4 ± 15.2 on 32 tracks"]
    assert list(two.values()) == [2, 700, 170_000, 0.96, 0.93, "0.80 ± 0.01", None, "refused", None]


def test_a_round_says_whose_model_it_evolved_in():
    rounds = describe_rounds(*FIRST, *SECOND, entry(2, "evolve", score={**SCORE, "mean": 900.0, "confirmed": False}))
    assert [each["evolved_in"] for each in rounds] == [1, 1]
    assert summary.best_round(rounds)["round"] == 2
    assert summary.format_score(rounds[1]["score"]) == "900.0 ± 15.2 on 32 tracks, provisional"


def test_a_round_in_its_midst_has_no_model_that_was_kept_and_without_a_score_none_is_best():
    for begun in (SECOND[:1], SECOND[:2]):
        assert summary.table_rows(describe_rounds(*FIRST, *begun))[-1]["model"] is None
    assert summary.best_round(describe_rounds(*FIRST[:2])) is None


@pytest.mark.parametrize(
    ("finished", "said"),
    [
        (FIRST[0], "round 1  collect      1.5 s  620 drives, 620 in all"),
        (entry(3, "mdnrnn", **QUALITY), "round 3  mdnrnn       1.5 s  nats_per_dimension 0.96, reward_auc 0.93"),
        (SECOND[2], "round 2  gate         1.5 s  refused"),
        (entry(1, "encode"), "round 1  encode       1.5 s"),
    ],
)
def test_a_line_has_round_phase_time_and_outcome(finished, said):
    assert summary.format_entry(finished).split() == said.split()
