"""`dreamfleet card`: the folder, and its script without dreamfleet.

Tests card_page.py, driver_graph.py, score_chart.py, verb.py, common/addons/markdown.py,
worker/worlds/car_racing/standalone_drive.py and worker/worlds/gym/standalone_play.py.
"""

import json
import subprocess
import sys
from dataclasses import replace
from itertools import product
from xml.etree import ElementTree

import av
import numpy as np
import onnx
import pytest
import yaml
from markdown_it import MarkdownIt

from dreamfleet import UsageError, evaluate, find_controller
from dreamfleet.common.addons.evaluation_report import read_evaluation_report
from dreamfleet.common.artifacts.controller import IMPORTED, Controller, ControllerShape
from dreamfleet.common.cli.command_line import main
from dreamfleet.common.printable import one_line
from dreamfleet.common.runs.lookup import find_bundle_of
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.worker.addons.card.card import seed_to_film, write_card
from dreamfleet.worker.addons.card.card_page import CardContents, describe_card
from dreamfleet.worker.addons.card.driver_graph import export_driver, largest_difference
from dreamfleet.worker.addons.card.score_chart import draw_scores
from dreamfleet.worker.addons.evaluation.agents import make_agent
from dreamfleet.worker.addons.evaluation.evaluation import judge
from dreamfleet.worker.addons.evaluation.known_score import find_known_score
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worldmodel.inference import open_graph
from dreamfleet.worker.worldmodel.mdnrnn_config import REWARDED
from tests.support.bundles import write_random_bundle
from tests.support.dreams import write_bundle_of
from tests.support.processes import ROOT
from tests.support.tasks import TOY
from tests.support.variants import VARIANTS, controller_of, vectors

REPORT = ROOT / "docs" / "lab" / "results" / "real.json"
SCORES = {"hidden": 123.4, "foreign": 56.7}  # of blind drives
WITHOUT_DREAMFLEET = (
    "import runpy, sys; sys.modules['dreamfleet'] = None; runpy.run_path('drive.py', run_name='__main__')"
)


@pytest.fixture(scope="module")
def card(tmp_path_factory):
    folder = tmp_path_factory.mktemp("card") / "real"
    assert main(["card", "real", str(REPORT), "--steps", "20", "--out", str(folder)]) == 0
    return folder


def run_script(folder, *seeds):
    """The scores that the folder's script prints in a process without dreamfleet, by seed."""
    words = [sys.executable, "-c", WITHOUT_DREAMFLEET, *map(str, seeds)]
    lines = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=True).stdout.splitlines()
    return {int(seed): float(score) for seed, score in (line.split() for line in lines)}


@pytest.mark.slow
def test_the_folder_holds_what_its_card_names(card):
    text = (card / "README.md").read_text()
    names = {each.name for each in card.iterdir()}
    assert names == {
        "README.md", "bundle.zip", "controller.npz", "controller.onnx", "drive.py", "evaluation.json", "replay.mp4",
        "scores.png",
    }  # fmt: skip
    assert all(f"`{name}`" in text for name in names - {"README.md"})
    assert "915.2" in text
    assert read_evaluation_report(card / "evaluation.json") == read_evaluation_report(REPORT)
    assert Controller.load(card / "controller.npz").sha256 in text
    with av.open(str(card / "replay.mp4")) as video:
        assert sum(1 for _ in video.decode(video=0)) >= 20
    assert (card / "scores.png").read_bytes().startswith(b"\x89PNG")
    graph = onnx.load(card / "controller.onnx", load_external_data=False).graph
    assert [each.name for each in graph.input] == ["picture", "state"]
    assert not any(each.external_data for each in graph.initializer)


def test_the_video_shows_the_same_median_drive_with_a_report_and_without():
    report, known = read_evaluation_report(REPORT), find_known_score(find_controller("real"))
    assert len(report.drives) % 2 == 0
    assert seed_to_film(report, known) == seed_to_film(None, known) == known.median_seed


def test_a_hub_reads_the_metadata(card):
    head = yaml.safe_load((card / "README.md").read_text().split("---")[1])
    assert head["license"] == "other"
    assert {"reinforcement-learning", "car-racing", "world-models", "onnx"} <= set(head["tags"])
    (result,) = head["model-index"][0]["results"]
    assert result["dataset"] == {"name": "car-racing", "type": "car-racing"}
    (metric,) = result["metrics"]
    assert (metric["type"], metric["value"]) == ("mean_reward", "915.19 +/- 29.51")


@pytest.mark.slow
def test_the_script_scores_as_evaluate_does(card):
    """To the bit, on a seed that the report has; without dreamfleet."""
    found = run_script(card, 10001)[10001]
    wanted = {each["seed"]: each["score"] for each in json.loads(REPORT.read_text())["drives"]}
    assert found == pytest.approx(wanted[10001], abs=30)  # another processor may round otherwise
    assert found == evaluate(find_controller("real"), episodes=1, first_seed=10001, jobs=1).scores[0]


@pytest.mark.parametrize(
    ("task", "hidden", "options"),
    [
        ("gym:CartPole-v1", 4, {"normalise": True, "seed": 3}),
        ("gym:Pendulum-v1", 0, {"environment": {"g": 9.0}}),
        ("gym:Blackjack-v1", 0, {}),
    ],
)
def test_the_script_plays_any_environment_as_evaluate_does(tmp_path, task, hidden, options):
    described = find_task(task).describe(options)
    shape = ControllerShape(described.observations, described.outputs, hidden)
    parameters = np.random.default_rng(5).normal(0, 0.5, shape.size).astype(np.float32)
    controller = Controller(shape, parameters, task, "", {}, described.options, described.version)
    controller.save(tmp_path / "own.npz")
    assert main(["card", str(tmp_path / "own.npz"), "--steps", "0", "--out", str(tmp_path / "card")]) == 0
    assert {each.name for each in (tmp_path / "card").iterdir()} == {"README.md", "controller.npz", "drive.py"}
    results = evaluate(controller, episodes=3, first_seed=10000, jobs=1)
    assert run_script(tmp_path / "card", *results.seeds) == dict(zip(results.seeds, results.scores, strict=True))


def test_a_controller_that_the_script_cannot_drive_has_none(tmp_path):
    assert main(["card", "takecover", "--steps", "0", "--out", str(tmp_path / "cover")]) == 0
    assert not (tmp_path / "cover" / "drive.py").exists()
    assert (tmp_path / "cover" / "controller.onnx").exists()
    known = find_known_score(Controller.load(tmp_path / "cover" / "controller.npz"))
    scores = (tmp_path / "cover" / "README.md").read_text().partition("## Scores")[2]
    assert format_with_error(known.mean, known.error) in scores.partition("## Use")[0]


def test_a_report_of_another_controller_and_a_folder_in_use_are_refused(tmp_path, capsys):
    assert main(["card", "tiny", str(REPORT), "--out", str(tmp_path / "tiny")]) == 2
    assert read_evaluation_report(REPORT).controller[:12] in capsys.readouterr().err
    (tmp_path / "mine").write_text("")
    assert main(["card", "real", "--out", str(tmp_path)]) == 2
    assert "--out" in capsys.readouterr().err


@pytest.mark.parametrize("changes", [
    {"world": "car-racing"}, {"options": '{"normalise": false}'}, {"judge": "dodge"}, {"threshold": 1.0},
    {"marks": (1.0,)}, {"bundle": "ab" * 32}, {"task": "car-racing"},
])  # fmt: skip
def test_a_report_of_another_world_is_refused(tmp_path, changes):
    described = find_task("gym:CartPole-v1").describe({"normalise": True})
    shape = ControllerShape(described.observations, described.outputs)
    parameters = np.zeros(shape.size, np.float32)
    own = Controller(shape, parameters, "gym:CartPole-v1", "", {}, described.options, described.version)
    report = judge("own", make_agent(own), (10_000,), 1)
    out = tmp_path / "card"
    with pytest.raises(UsageError, match=next(iter(changes))):
        write_card(CardContents(own, None, replace(report, **changes), "own"), out, 0)
    assert not out.exists()
    assert "evaluation.json" in write_card(CardContents(own, None, report, "own"), out, 0)


def test_an_imported_controller_has_a_card(tmp_path):
    np.save(tmp_path / "v.npy", np.zeros(867))
    assert main(["import", str(tmp_path / "v.npy"), "--like", "tiny", "--out", str(tmp_path / "zeros.npz")]) == 0
    assert main(["card", str(tmp_path / "zeros.npz"), "--steps", "0", "--out", str(tmp_path / "card")]) == 0
    assert (tmp_path / "card" / "drive.py").exists()
    assert "`v.npy`" in (tmp_path / "card" / "README.md").read_text()


@pytest.mark.parametrize(
    "name",
    ["# <b>x</b>", "[x](javascript:1)", "a`b``c", "1. x*y*_z_", "- x\n# y", "<script>&amp;", "$\\frac$ ~~x~~",
     "\u202eé"],
)  # fmt: skip
def test_a_card_shows_each_name_as_it_is(name):
    controller = Controller(ControllerShape(1, 1), np.zeros(2, np.float32), f"gym:{name}", "", {IMPORTED: name})
    report = replace(read_evaluation_report(REPORT), judge=f"{name} judge", version=f"{name} version")
    text = "\n".join(describe_card(CardContents(controller, None, report, name), []))
    _, head, page = text.split("---\n", 2)
    found = yaml.safe_load(head)
    shown = one_line(name)
    assert found["tags"][2] == found["model-index"][0]["results"][0]["dataset"]["name"] == shown
    assert found["model-index"][0]["name"] == shown
    page = page.split("```json")[0]
    title, *elements = ElementTree.fromstring(f"<page>{MarkdownIt('commonmark').render(page)}</page>")
    assert (title.tag, title.text, len(title)) == ("h1", shown, 0)
    tags = {each.tag for element in elements for each in element.iter()}
    assert tags <= {"h2", "p", "ul", "li", "img", "pre", "code", "video"}
    assert [each.text for each in elements[0].iter("code")] == [f"gym:{shown}", "dreamfleet", shown]
    scores = "".join(elements[2].itertext())
    assert f"{shown} judge" in scores
    assert f"{shown} version" in scores
    assert draw_scores(report, name)


def test_a_card_has_the_blind_scores_beside_the_plain_one():
    controller, plain = (
        Controller(ControllerShape(1, 1), np.zeros(2, np.float32), TOY, ""),
        read_evaluation_report(REPORT),
    )
    blind = {sight: tuple(replace(each, score=score) for each in plain.drives) for sight, score in SCORES.items()}
    report = replace(plain, **blind, asked_loss=100.0)
    text = "\n".join(describe_card(CardContents(controller, None, report, "toy"), []))
    loss = format_with_error(report.figures["hidden_loss"], report.figures["hidden_loss_error"])
    assert all(f"{score:.1f}" in text for score in (plain.results.mean, *SCORES.values()))
    assert loss in text
    assert report.describe_sight() in text


def test_what_draws_no_pictures_has_a_card_without_a_video_that_says_why(tmp_path, capsys):
    Controller(ControllerShape(1, 1), np.zeros(2, np.float32), TOY, "").save(tmp_path / "toy.npz")
    assert main(["card", str(tmp_path / "toy.npz"), "--out", str(tmp_path / "card")]) == 0
    assert TOY in capsys.readouterr().out
    assert "<video" not in (tmp_path / "card" / "README.md").read_text()


def difference(controller, bundle):
    return largest_difference(bundle, controller, export_driver(bundle, controller))


@pytest.mark.parametrize("name", ["tiny", "real", "dream", "takecover", "takecover-real"])
def test_what_ships_acts_by_one_graph_to_the_bit(name):
    controller = find_controller(name)
    assert difference(controller, find_bundle_of(controller, None)) == 0


def test_every_shape_of_controller_acts_to_the_bit(random_bundle, tmp_path):
    for features, hidden in product(("z", "zh"), (0, 5)):
        own = random_bundle.with_controllers(random_bundle.shape_of(features, hidden))
        assert difference(controller_of(own), random_bundle) == 0
    attentive = write_random_bundle(tmp_path / "attentive.zip", rnn=replace(REWARDED, window=3, dropout=0.1))
    assert difference(controller_of(attentive), attentive) == 0
    bundle = write_bundle_of("groups", tmp_path / "groups.zip")
    for options in ("", '{"decide_every": 3, "feedback": "last"}'):
        own = bundle.with_options(None, options)
        about = own.controller_shape, vectors(own, 1)[0], bundle.manifest.task, bundle.sha256
        assert difference(Controller(*about, options=options), bundle) == 0


@pytest.mark.parametrize("name", VARIANTS)
def test_a_variant_acts_as_numpy_computes_it(random_bundle, name):
    """Its choices to the bit; of continuous actions NumPy's last bits differ from ONNX Runtime's."""
    controller = controller_of(random_bundle.with_controllers(None, VARIANTS[name]))
    exact = VARIANTS[name].actions == "discrete"
    found = difference(controller, random_bundle)
    assert found == 0 if exact else found < 1e-5


def test_the_graph_has_two_inputs_and_a_batch(random_bundle):
    controller = controller_of(random_bundle)
    graph = open_graph(export_driver(random_bundle, controller), threads=1)
    assert [each.name for each in graph.get_inputs()] == ["picture", "state"]
    assert [each.name for each in graph.get_outputs()] == ["action", "next_state"]
    pictures = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), np.uint8)
    state = np.zeros((3, graph.get_inputs()[1].shape[1]), np.float32)
    together, _ = graph.run(None, {"picture": pictures, "state": state})
    alone, _ = graph.run(None, {"picture": pictures[1:2], "state": state[1:2]})
    assert np.array_equal(together[1:2], alone)


def test_what_a_picture_alone_cannot_drive_is_refused(tmp_path):
    rewarded = write_random_bundle(tmp_path / "rewarded.zip", rnn=replace(REWARDED, previous_reward=True))
    with pytest.raises(UsageError):
        export_driver(rewarded, controller_of(rewarded))
