"""The frames that a worker sends while somebody subscribes; they change and delay nothing. Tests frame_sampler.py."""

import multiprocessing
import queue

import numpy as np
import pytest
import zenoh

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import decode
from dreamfleet.common.protocol.frame_pictures import unpack_picture
from dreamfleet.common.protocol.messages import Intervals, TaskSpec, ViewFrame
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.worker.service.child import ScorerArguments
from dreamfleet.worker.service.frame_sampler import FRAME_INTERVAL, MAX_TIME_SHARE, FrameSampler
from dreamfleet.worker.service.slot import Slot
from dreamfleet.worker.tasks.watching import StepSnapshot
from tests.support import tasks
from tests.support.hand import DEADLINE, tag
from tests.support.samples import job

ACTION = (0.0, 1.0)


class Viewer:
    def __init__(self, hand):
        self._frames = queue.SimpleQueue()
        self.session = open_session(Network(connect=(hand.endpoint,)))
        heard = zenoh.handlers.Callback(self._frames.put, indirect=False)
        self._subscriber = self.session.declare_subscriber(keys.view(hand.run, hand.worker), heard)

    def frame(self, accept=lambda _: True):
        while True:
            frame = decode(ViewFrame, self._frames.get(timeout=DEADLINE).payload.to_bytes())
            if accept(frame):
                return frame


@pytest.fixture
def hand(stage):
    """A coordinator that is never considered silent."""
    made = stage.hand(tasks.PAINTED)
    made.intervals = Intervals(beat=10.0, repeat=0.1)
    return made


@pytest.fixture
def viewer():
    made = []

    def make(hand):
        made.append(Viewer(hand))
        return made[-1]

    yield make
    for each in made:
        each.session.close()


@pytest.mark.slow
def test_one_of_two_slots_is_shown(stage, hand, cached, viewer):
    stage.worker(slots=2)
    hand.hello()
    hand.beat(lambda beat: beat.capacity == 2)
    watching = viewer(hand)
    hand.send(1, *(hand.job(episode) for episode in range(6)))
    assert {watching.frame().slot for _ in range(5)} == {0}


@pytest.mark.slow
def test_a_viewer_sees_the_running_job_and_its_observation(stage, hand, cached, viewer):
    stage.worker()
    hand.ready()
    watching = viewer(hand)
    jobs = hand.job(0), hand.job(1), hand.job(2)
    hand.send(1, *jobs)
    seen = [watching.frame()]
    while seen[-1].tag == seen[0].tag:
        seen.append(watching.frame())
    shown = next(each for each in jobs if tag(each) == seen[0].tag)
    for frame in seen[:-1]:
        assert (frame.run_uid, frame.slot, frame.kind) == (hand.run_uid, 0, "score")
        assert (frame.generation, frame.candidate, frame.seed) == (shown.generation, shown.candidate, shown.seeds[0])
        assert (unpack_picture(frame) == frame.step).all()
        assert len(frame.action) == 8
    steps = [frame.step for frame in seen[:-1]]
    assert steps == sorted(steps)
    rewards = [frame.reward for frame in seen[:-1]]
    assert rewards == sorted(rewards, reverse=True), "they are summed up, and each is below 0"
    other = viewer(hand)
    watching.session.close()  # without notice
    hand.send(2, hand.job(3))
    assert other.frame(lambda frame: frame.tag == tag(hand.job(3)))
    assert hand.result(hand.job(3)).error is None


@pytest.mark.slow
def test_after_a_slot_was_killed_in_the_middle_the_next_child_is_watched(stage, hand, cached, viewer):
    stage.worker()
    hand.ready()
    watching = viewer(hand)
    jobs = [hand.job(episode) for episode in range(5)]
    hand.send(1, *jobs)
    watching.frame()
    (child,) = multiprocessing.active_children()
    child.kill()  # in any job but the last
    frame = watching.frame(lambda frame: frame.tag == tag(jobs[-1]))
    (another,) = multiprocessing.active_children()
    assert another is not child
    assert (unpack_picture(frame) == frame.step).all()


@pytest.mark.parametrize("task", ["car-racing", "dream", "gym:CartPole-v1"])
def test_a_slot_gives_the_same_bits_watched_and_not(random_bundle, task):
    events, announced = queue.SimpleQueue(), ("car-racing", "dream", "gym")
    sha256, path = ("", None) if task.startswith("gym") else (random_bundle.sha256, random_bundle.path)
    shape = ControllerShape(4, 2) if path is None else random_bundle.controller_shape
    spec = TaskSpec(task, sha256, 60, 0, controller=None if path else shape)
    vector = np.random.default_rng(0).normal(0, 0.1, shape.size).astype("<f4").tobytes()
    slot = Slot(0, ScorerArguments(spec, path, announced), events)
    outcomes, frames = [], 0
    while not slot.ready:
        slot.handle(events.get(timeout=DEADLINE)[1])
    for shown in (False, True, False):
        slot.show(shown)
        slot.submit([(job(row, spec=spec), vector) for row in range(3 if task == "dream" else 1)])
        while not (results := slot.handle(event := events.get(timeout=DEADLINE)[1])):
            assert shown
            frames += slot.find_job(event.child_number, event.message) is not None
        outcomes.append([(each.fitness, each.steps, each.error) for each in results])
    slot.stop()
    assert outcomes[0] == outcomes[1] == outcomes[2]
    assert outcomes[0][0][2] is None
    assert frames >= 1


def test_expensive_frames_take_at_most_a_hundredth_of_the_time():
    now, frames = [0.0], []
    sampler = FrameSampler(frames.append, lambda: True, lambda: now[0], lambda: now[0])

    def look():
        now[0] += 0.05
        return StepSnapshot(0, 0.0, ACTION)

    for _ in range(100_000):
        if sampler.is_due():
            sampler.observe(0, look)
        now[0] += 0.001
    assert 0.05 * len(frames) <= 1.1 * MAX_TIME_SHARE * now[0]
    assert len(frames) > 10


def test_cheap_frames_come_ten_a_second_while_somebody_watches():
    now, frames, wanted = [0.0], [], [True]
    sampler = FrameSampler(frames.append, lambda: wanted[0], lambda: now[0], lambda: now[0])
    while now[0] < 10:
        if sampler.is_due():
            sampler.observe(0, lambda: StepSnapshot(0, 0.0, ACTION))
        now[0] += 0.001
    assert len(frames) == pytest.approx(10 / FRAME_INTERVAL, abs=3)
    wanted[0] = False
    now[0] += 10
    assert not sampler.is_due()


def test_an_error_while_sampling_fails_no_job():
    sampler = FrameSampler(lambda _seen: 1 / 0, lambda: True)
    sampler.observe(0, lambda: StepSnapshot(0, 0.0, ACTION))
    assert not sampler.is_due()
