import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.client.status import WorkerStatus, read_document, read_status
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.runs.episode_results import EpisodeResult, EpisodeResults, FailedEpisode
from dreamfleet.coordinator.addons.runs.stored_run import StoredRun
from dreamfleet.worker.worlds.trained_agent import AgentManifest, TrainedAgent
from tests.support.journals import RUNS

GOLDEN = Path(__file__).parents[1] / "golden"
SHAPE = ControllerShape(4, 2, hidden=3)
CONTROLLER = Controller(SHAPE, np.zeros(SHAPE.size, np.float32), "gym:CartPole-v1", "", {"generation": 7})
WORKER = WorkerStatus("alpha/0011aabb", "lost", 2, 1, 14, 1234.5, 0.5, "native", 3.25, "f", reason="it was stopped")
RESULTS = EpisodeResults((EpisodeResult(1, 10.0, 5), EpisodeResult(2, 14.0, 5)), (FailedEpisode(3, "a <fault>"),))
AGENT = TrainedAgent(AgentManifest("drqn", "car-racing", "box-64", ((0.0, 1.0),), 3, 16), b"graph")


def table_of(shown):
    """The caption and the rows of a table in HTML, which is well-formed."""
    table = ET.fromstring(shown._repr_html_())
    return table.find("caption").text, {row.find("th").text: row.find("td").text for row in table.iter("tr")}


def test_in_a_repl_it_is_one_line_without_what_is_at_its_default():
    assert repr(SHAPE) == "ControllerShape(features=4, actions=2, hidden=3)"
    found = repr(TaskSpec("dream", "", 500, 0, temperature=1.5))
    assert found == "TaskSpec(task='dream', bundle='', horizon=500, patience=0, temperature=1.5)"
    for part in ("gym:CartPole-v1", " 23 ", " 4 ", " 2 ", " 3 ", CONTROLLER.sha256[:12]):
        assert part in repr(CONTROLLER)
    assert "2 episodes: 12.0 ± 2.0, 10 to 14, 1 failed" in repr(RESULTS)


def test_a_status_says_where_the_run_is():
    found = read_status(read_document((GOLDEN / "status.v2.json").read_bytes()))
    card = "".join(ET.fromstring(found._repr_html_()).itertext())
    for shown, datum in ((repr(found), str(found.generation.episodes)), (card, found.settings.task.task)):
        for part in (found.run, found.state, f"generation {found.generation.number}", datum):
            assert part in shown


@pytest.mark.parametrize("shown", [CONTROLLER, RESULTS, WORKER, AGENT, TaskSpec("t", "", 5, 0), find_bundle("tiny")])
def test_in_a_notebook_it_is_a_small_table(shown):
    caption, facts = table_of(shown)
    assert caption in repr(shown)
    assert 2 <= len(facts) <= 9
    assert "None" not in facts.values()


def test_names_from_elsewhere_are_text_and_nothing_else():
    assert WORKER.name == "alpha"
    hostile = replace(WORKER, worker="<script>alert(1)</script>\x1b[2J\nnext", reason="x" * 5000)
    caption, facts = table_of(hostile)
    assert "<script>" not in hostile._repr_html_()
    assert "<script>alert(1)</script>" in caption
    assert not {"\x1b", "\n"} & set(repr(hostile))
    assert len(facts["reason"]) <= 200


def test_a_run_is_shown_live_ended_or_closed(tmp_path):
    with StoredRun(RUNS / "reality") as run:
        caption, facts = table_of(run)
        assert repr(run) == f"<{caption}>" == "<Run reality of car-racing: 3 generations, ended: 3 generations>"
        assert facts["best evaluation"].startswith("-27.5 ± ")
    assert repr(run).startswith("<Run reality: "), "closed, and no error"
