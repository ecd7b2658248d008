"""Live frames of workers and of drives for the viewer, and their outputs.
Tests frame_sinks.py, live_view.py and common/addons/frames/mjpeg.py."""

import io
import json
from itertools import islice, takewhile

import numpy as np
import pytest

from dreamfleet.common.addons.frames.live import LiveFrame
from dreamfleet.common.addons.frames.mjpeg import read_parts
from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.protocol.codec import decode, encode
from dreamfleet.common.protocol.frame_pictures import pack_picture
from dreamfleet.common.protocol.messages import TaskSpec, ViewFrame
from dreamfleet.worker.addons.evaluation.agents import make_agent
from dreamfleet.worker.addons.live.frame_sinks import encode_picture, open_sink
from dreamfleet.worker.addons.live.live_sources import driven_frames
from dreamfleet.worker.addons.live.live_view import AHEAD, SIZE, CaptionedFrame, LiveCanvas, LiveDreamer
from dreamfleet.worker.addons.recording.canvas import Canvas
from dreamfleet.worker.addons.recording.parallel_dream import ParallelDreamConfig
from dreamfleet.worker.scoring import episode
from dreamfleet.worker.scoring.episode import EpisodeConfig
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.worldmodel.inference import Decoder
from tests.support.samples import HEAD
from tests.support.watching import Watching

SEED = 10_003
PARAMETERS = np.random.default_rng(0).normal(0, 0.1, 867).astype(np.float32)


def live_frame_of(bundle, task, **more):
    """A worker's frame of one step of a task."""
    scorer, eyes = Scorer(TaskSpec(task, bundle.sha256, 20, 0, temperature=1.0), bundle), Watching(every=10)
    scorer.observer = eyes
    scorer.score("score", PARAMETERS, 2**20)
    scorer.close()
    seen = eyes[0][1]
    picture = (1, 1, b"") if seen.picture is None else pack_picture(seen.picture)
    numbers = [each.astype("<f4").tobytes() for each in (seen.latent, seen.state, PARAMETERS)]
    facts = {
        "slot": 0, "tag": b"ABCDEFGH", "step": seen.step, "reward": seen.score, "height": picture[0],
        "width": picture[1], "picture": picture[2], "packed": bool(picture[2]), "generation": 7, "candidate": 2,
        "seed": 2**20, "action": tuple(map(float, seen.action)), "latent": numbers[0], "state": numbers[1],
        "parameters": numbers[2], **more,
    }  # fmt: skip
    return LiveFrame.of("host-a/0a1b2c3d", decode(ViewFrame, encode(ViewFrame(**HEAD, **facts))))


@pytest.mark.parametrize("task", ["car-racing", "dream"])
def test_the_viewer_decodes_a_workers_frame_and_continues_it_as_a_dream(random_bundle, task):
    live, dreamer = live_frame_of(random_bundle, task), LiveDreamer(random_bundle, 1.0)
    dream = dreamer.decode_and_dream(live)
    assert (dream.decoded == Decoder(random_bundle).decode(live.latent[None])[0]).all()
    assert [ahead for ahead, _ in dream.dreamt] == list(AHEAD)
    assert len({picture.tobytes() for _, picture in dream.dreamt}) == len(AHEAD)
    again = dreamer.decode_and_dream(live).dreamt
    assert all(np.array_equal(one, other) for (_, one), (_, other) in zip(dream.dreamt, again, strict=True))
    shown = LiveCanvas("night", ("steer", "gas", "brake"), dreamer).draw(live)
    assert shown.picture.shape == (*SIZE[::-1], 3)
    captions = shown.facts.pop("captions")
    assert len(captions) == len(AHEAD) + (1 if task == "dream" else 2)
    assert shown.facts == {
        "run": "night", "worker": "host-a/0a1b2c3d", "kind": "score", "generation": 7, "candidate": 2, "seed": 2**20,
        "step": 9, "score": live.frame.reward, "drawn": True,
    }  # fmt: skip
    assert (live.picture is None) == (task == "dream")


@pytest.mark.parametrize(
    "more",
    [{"latent": bytes(8)}, {"latent": b""}, {"state": bytes(8)}, {"parameters": bytes(16)},
     {"picture": b"", "packed": False}, {"action": (1e300,)}],
)  # fmt: skip
def test_a_frame_of_another_world_model_is_shown_without_the_model(random_bundle, more):
    live = live_frame_of(random_bundle, "car-racing", **more)
    canvas = LiveCanvas("n" * 63, ("steer", "gas", "brake"), LiveDreamer(random_bundle, 1.0))
    assert canvas.draw(live).picture.shape == (*SIZE[::-1], 3)
    assert LiveCanvas("night").draw(live).facts["drawn"] == ("picture" not in more)


@pytest.mark.slow
def test_a_controller_is_shown_in_real_time_and_scores_the_same(random_bundle):
    controller = Controller(random_bundle.controller_shape, PARAMETERS, "car-racing", random_bundle.sha256)
    agent = make_agent(controller, random_bundle)
    shown = list(islice(driven_frames(lambda: (agent, {}), ParallelDreamConfig(), 10, SEED), 8))
    assert [each.facts["step"] for each in shown] == list(range(0, 40, 5)), "50 steps a second, 10 pictures"
    judge = agent.make_evaluation_environment()
    plain = episode.score(judge, agent.make_policies()(SEED), PARAMETERS, EpisodeConfig(SEED, 35))
    judge.close()
    assert shown[7].facts["score"] == pytest.approx(plain.fitness)
    assert shown[0].facts["seed"] == SEED
    assert len({each.picture.tobytes() for each in shown}) == 8


def test_the_end_of_an_episode_is_shown_for_a_second(monkeypatch):
    ends = []
    monkeypatch.setattr(Canvas, "_draw_end", lambda _self, text: ends.append(text))
    falling = make_agent(Controller(ControllerShape(4, 2), np.zeros(10, np.float32), "gym:CartPole-v1", ""))
    pictures = driven_frames(lambda: (falling, {}), ParallelDreamConfig(), 10, SEED)
    shown = [each.facts for each in takewhile(lambda each: each.facts["seed"] == SEED, pictures)]
    last = shown[-1]
    assert [each for each in shown if each["step"] == last["step"]] == [last] * 10
    assert (last["score"], len(ends), str(last["step"]) in ends[0]) == (last["step"], 1, True)


PICTURES = [CaptionedFrame(np.full((40, 60, 3), value, np.uint8), {"step": value}) for value in (10, 200, 90)]


def test_pictures_are_in_a_folder_with_their_facts(tmp_path):
    with open_sink(str(tmp_path / "new" / "stills"), 10, io.BytesIO()) as show:
        assert all(show(each) for each in (None, *PICTURES))
    assert sorted(path.name for path in (tmp_path / "new" / "stills").iterdir()) == [
        f"{number:06d}.{kind}" for number in range(3) for kind in ("json", "png")
    ]
    assert json.loads((tmp_path / "new" / "stills" / "000001.json").read_text()) == {"step": 200}


def test_a_stream_has_every_picture_and_ends_when_its_reader_leaves(tmp_path):
    out = io.BytesIO()
    with open_sink("-", 10, out) as show:
        assert all(show(each) for each in (None, *PICTURES))
    out.seek(0)
    parts = list(read_parts(out))
    assert [facts for _, facts in parts] == [each.facts for each in PICTURES]
    assert parts[0][0] == encode_picture(PICTURES[0].picture, "jpg")
    assert list(read_parts(io.BytesIO(out.getvalue()[:-200]))) == parts[:2], "the last one is cut short"
    assert list(read_parts(io.BytesIO(b"HTTP/1.1 200 OK\r\n\r\n"))) == []

    class Gone(io.BytesIO):
        def write(self, _data):
            raise BrokenPipeError

    with open_sink("-", 10, Gone()) as show:
        assert not show(PICTURES[0])


def test_unwritable_outputs_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    for name, error in (("live.webm", UsageError), ("file", UsageError), ("file/stills", DreamfleetError),
                        ("file/live.mp4", DreamfleetError)):  # fmt: skip
        with pytest.raises(error, match="--out"), open_sink(str(tmp_path / name), 10, io.BytesIO()):
            pass
