"""What hosts without a simulator know of a shipped world is what its task says.

Tests profile.py, score_words.py, shipped.py, common/addons/worlds/car_racing.py, common/addons/worlds/takecover.py and
worker/addons/evaluation/known_score.py.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dreamfleet import find_controller
from dreamfleet.common.addons.evaluation_report import read_evaluation_report
from dreamfleet.common.artifacts.bundle_store import pretrained_folder
from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.cli.presets import default_run_preset, default_training_preset
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import DREAM, is_shipped
from dreamfleet.common.runs.seeds import TEST
from dreamfleet.common.worlds.score_words import profile_of, score_word_of_run
from dreamfleet.common.worlds.shipped import WORLDS
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.worker.addons.evaluation.known_score import KnownScore, find_known_score, first_seed, median_drive
from dreamfleet.worker.tasks.registry import find_world
from dreamfleet.worker.training.presets import PRESETS
from tests.support.bundles import write_world_bundle
from tests.support.dreams import MODELS, VAE
from tests.support.dreams import WORLDS as DREAMT


@pytest.mark.parametrize("profile", WORLDS.values(), ids=WORLDS)
def test_a_profile_agrees_with_its_task(profile):
    world = find_world(profile.task).world
    assert is_shipped(profile.task)
    assert world.preset == profile.default_training == default_training_preset(profile.task)

    assert profile.score_word == world.score_word
    assert profile.demo.preset in profile.run_presets
    assert profile.dream_preset == default_run_preset(profile.task)
    assert profile.run_presets[profile.dream_preset]["task"] == DREAM
    for settings in profile.run_presets.values():
        assert settings.get("task", profile.task) in (DREAM, profile.task)
        assert settings.keys() <= RunConfig.__dataclass_fields__.keys()
    for name in profile.training_presets:
        assert PRESETS[name].task == profile.task


def test_a_run_calls_a_seed_what_its_bundles_world_does(tmp_path, random_bundle):
    facts = replace(DREAMT["choices"], score_word="flight")
    flights = write_world_bundle(tmp_path / "b.zip", facts, "gym:Some-v0", vae=VAE, rnn=MODELS["choices"])
    for bundle, word in ((flights, "flight"), (random_bundle, "track")):
        spec = TaskSpec(DREAM, bundle.sha256, 9, 0)
        assert score_word_of_run(spec, bundle.path) == word
        assert score_word_of_run(spec, tmp_path / "gone.zip") == "seed"
    assert score_word_of_run(TaskSpec("takecover", "", 9, 0), tmp_path / "none.zip") == "game"


RESULTS = Path(__file__).parents[3] / "docs" / "lab" / "results"


def test_the_scores_of_shipped_controllers_are_those_of_the_reports():
    known = {}
    for path in RESULTS.glob("*.json"):
        report = read_evaluation_report(path)
        drives, found = {each.seed: each.score for each in report.drives}, report.results
        middle, _ = median_drive(drives)
        known[report.world, report.controller[:12]] = round(found.mean, 1), round(found.error, 1), len(drives), middle
    shipped = {
        (world.task, each.sha256): (each.mean, each.error, each.episodes, each.median_seed)
        for world in WORLDS.values()
        for each in world.shipped_scores
    }
    assert shipped == known
    names = [path.stem for path in pretrained_folder().glob("*.npz")]
    assert {find_controller(name).sha256[:12] for name in names} == {sha256 for _, sha256 in shipped}


@pytest.mark.parametrize(
    ("said", "known"),
    [
        ({"mean": 173.0, "error": 1.0, "episodes": 64}, KnownScore(173.0, 1.0, 64)),
        ({"mean": 173.0, "error": None, "episodes": 1}, KnownScore(173.0, None, 1)),
        ({"mean": None, "error": None, "episodes": None}, None),
        *(({"mean": odd, "episodes": 64}, None) for odd in ("much", float("nan"))),
        ({"mean": 3.0, "episodes": True}, None),
        ({}, None),
    ],
)
def test_what_a_controllers_file_says_of_its_mean_is_read_with_care(said, known):
    facts = {f"validation_{name}": value for name, value in said.items()}
    own = Controller(ControllerShape(4, 2), np.ones(10, np.float32), "gym:CartPole-v1", "", facts)
    assert find_known_score(own) == known
    assert first_seed(known) == TEST.start


@pytest.mark.parametrize(
    ("task", "score", "text", "ends"),
    [
        ("takecover", 2100.0, "2,100 .*60", ("2,100", "2,100")),
        ("car-racing", 909.39, r"909\.4 ", ("", "")),
        ("gym:CartPole-v1", -1.5, r" -1\.5$", (" 9 ", " 9 ")),
    ],
)
def test_a_score_and_an_end_are_in_the_words_of_the_world(task, score, text, ends):
    profile = profile_of(task)
    assert re.search(text, profile.format_score(score))
    said = [profile.describe_end(end, score, 9) for end in ("terminated", "truncated")]
    assert all(datum in each for datum, each in zip(ends, said, strict=True))
    assert len({*said, profile_of("car-racing").describe_end("finished", score, 9)}) == 3
