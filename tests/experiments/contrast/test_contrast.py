"""What a contrast trains, what it refuses, and what its figures come to. Tests config.py and summary.py."""

import json
import re
from unittest.mock import Mock

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.common.schema.validation import from_plain, to_plain
from dreamfleet.experiments.contrast.config import KINDS, Contrast, Trial
from dreamfleet.experiments.contrast.summary import TrialResult, describe_difference, differences, means, rows
from dreamfleet.experiments.contrast.trials import SETTINGS, StoredContrast, Trials
from dreamfleet.experiments.local.kept_document import write_document
from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig


def test_the_two_kinds_that_ship_have_as_many_parameters():
    models = MDNRNN(MDNRNNConfig()), MDNRNN(MDNRNNConfig(window=8, hidden=236))
    plain, attentive = (sum(each.numel() for each in model.parameters()) for model in models)
    assert KINDS == (("plain", ""), ("attentive", "--set window=8 hidden=236"))
    assert abs(plain - attentive) < plain / 200


def test_kinds_take_turns_and_own_flags_come_last():
    contrast = Contrast(seeds=(4, 5), mdnrnn_flags="--updates 9 --set hidden=8")
    assert [each.name for each in contrast.trials] == ["plain-4", "attentive-4", "plain-5", "attentive-5"]
    words = contrast.training_flags(Trial("attentive", 5))
    assert words == ("--updates", "9", "--set", "hidden=8", "--set", "window=8", "hidden=236")
    for world, preset in (("car-racing", "dream"), ("takecover", "takecover"), ("gym:ALE/Pong-v5", "pixels")):
        assert contrast.run_flags_in(world) == ("--preset", preset, "--generations", "32")


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"kinds": (("alone", ""),)}, "--kind"),
        ({"kinds": (("one", ""), ("one", "--hidden 8"))}, "--kind one"),
        ({"kinds": (("../up", ""), ("one", ""))}, r"'\.\./up'"),
        ({"kinds": (("one", "--seed 3"), ("two", ""))}, "--seed"),
        ({"kinds": (("one", "--hid 'x"), ("two", ""))}, "No closing quotation"),
        ({"mdnrnn_flags": "--data elsewhere"}, "--data"),
        ({"seeds": ()}, "--seeds"),
        ({"seeds": (1, 1)}, "--seeds"),
        ({"seeds": (-1,)}, "--seeds"),
    ],
)
def test_what_is_no_contrast_is_refused(settings, named):
    with pytest.raises(UsageError, match=named):
        Contrast(**settings)


def test_seeds_and_kinds_may_be_added_but_none_changed():
    wide = ("wide", "--hidden 512")
    kept = Contrast(seeds=(4,), kinds=(KINDS[0], wide)).continue_from(Contrast())
    assert kept.kinds == (*KINDS, wide), "one that is not asked for this time is not forgotten"
    assert kept.seeds == (1, 2, 3, 4)
    with pytest.raises(UsageError, match="kind attentive"):
        Contrast(kinds=(KINDS[0], ("attentive", "--window 4"))).continue_from(kept)
    with pytest.raises(UsageError, match="run_flags"):
        Contrast(run_flags="--generations 3").continue_from(kept)
    stored = StoredContrast("data", 3, kept)
    assert from_plain(StoredContrast, json.loads(json.dumps(to_plain(stored)))) == stored


def test_a_data_set_that_grew_is_another_one(tmp_path):
    data, folder = tmp_path / "data", tmp_path / "out"
    for each in (data / "episodes", data / "encoded", folder):
        each.mkdir(parents=True)
    for each in ("vae.safetensors", "encoded/1", "encoded/2"):
        (data / each).touch()
    write_document(folder / SETTINGS, to_plain(StoredContrast(str(data), 1, Contrast())), "--out")
    with pytest.raises(UsageError, match=re.escape(str(folder))):
        Trials(Contrast(), data, folder, Mock(), Mock()).begin()


def outcome(kind, seed, nats, score):
    return TrialResult(kind, seed, 1000, {"nats_per_dimension": nats}, score, 5.0, 16, score is not None)


def test_kinds_are_compared_seed_by_seed():
    scores = ("plain", 1, 0.96, 700.0), ("attentive", 1, 0.95, 720.0), ("plain", 2, 0.98, 500.0)
    outcomes = [outcome(*each) for each in (*scores, ("attentive", 2, 0.97, 450.0))]
    found = {(kind, figure): each for kind, figure, each in differences(outcomes)}
    nats, score = found["attentive", "nats_per_dimension"], found["attentive", "score"]
    assert (nats.mean, nats.seeds, nats.is_significant) == (pytest.approx(-0.01), 2, True)
    assert (score.mean, score.is_significant) == (-15.0, False)
    assert re.search(r"-15\.0 .* 2 seeds.* 14\.0", describe_difference("attentive", "plain", "score", score))
    (plain,) = [each for each in means(outcomes) if (each.kind, each.figure) == ("plain", "score")]
    assert plain.text == "600.0 ± 100.0"
    assert rows(outcomes)[0]["reality"] == "700.0 ± 5.0 on 16"


def test_one_seed_has_no_error_and_no_difference_and_what_was_not_evaluated_no_score():
    outcomes = [outcome("plain", 1, 0.96, None), outcome("attentive", 1, 0.95, None)]
    assert list(differences(outcomes)) == []
    assert {each.figure for each in means(outcomes)} == {"nats_per_dimension"}
    assert means(outcomes)[0].text == "0.960"
    one_track = TrialResult("plain", 1, 10, {}, -80.0, None, 1)
    assert [each["reality"] for each in rows([*outcomes, one_track])] == ["not evaluated"] * 2 + [
        "-80.0 on 1, provisional"
    ]
