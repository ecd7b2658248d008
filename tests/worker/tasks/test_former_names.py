"""Tasks of other packages that still use the contract's former names."""

import dataclasses
from dataclasses import replace

import gymnasium
import numpy as np
import pytest

from dreamfleet.common.artifacts.actions import Discrete
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.service.frame_sampler import FrameSampler
from dreamfleet.worker.tasks.api import Score, StepSnapshot, World
from dreamfleet.worker.tasks.registry import find_task
from tests.support.tasks import Toy

PRESENT_AND_FORMER = ("make_evaluation_environment", "make_judge"), ("make_watched_environment", "make_shown")


class Former(Toy):
    name = "former"
    width = 4

    def make_judge(self, assignment):
        return gymnasium.wrappers.TransformReward(super().make_judge(assignment), lambda reward: reward + 100)

    def make_shown(self, assignment):
        return self.make_environment(assignment)

    def make_batch(self, assignment):
        return FormerBatch()


class FormerInInstance(Toy):
    name = "former in instance"

    def __init__(self):
        self.width = 8


class FormerWithoutBase:
    """It has the methods of a task without being a subclass of `Task`."""

    name, world, width = "former without base", Toy.world, 2
    world_of, make_environment, make_policy = Former.world_of, Toy.make_environment, Toy.make_policy
    seconds = 0.0

    def make_judge(self, assignment):
        return self.make_environment(assignment)


class FormerBatch:
    observer = None

    def watched(self, observer):
        self.observer = observer
        return self

    def score(self, episodes, on_step):
        if self.observer is not None and self.observer.due():
            self.observer.see(0, lambda: StepSnapshot(0, 0.0, np.zeros(8)))
        return [Score(1.0, 1) for _ in episodes]


def found(task):
    return find_task(f"{__name__}:{task.__name__}")


@pytest.mark.parametrize(("present", "former"), PRESENT_AND_FORMER)
def test_a_method_under_its_former_name_is_called_by_either(present, former):
    task = found(Former)
    assert getattr(task, present)(None) is not None
    assert type(getattr(task, present)(None)) is type(getattr(task, former)(None))
    plain = Toy()
    assert type(getattr(plain, present)(None)) is type(getattr(plain, former)(None))


def test_an_override_under_a_former_name_calls_that_of_its_base():
    judge = found(Former).make_evaluation_environment(None)
    judge.reset(seed=1)
    assert judge.step(np.zeros(8))[1] > 90


@pytest.mark.parametrize(("task", "size"), [(Former, 4), (FormerInInstance, 8), (FormerWithoutBase, 2)])
def test_a_width_is_the_batch_size(task, size):
    assert found(task).batch_size == size


def test_a_task_without_the_base_class_is_found_by_its_former_names():
    assert found(FormerWithoutBase).make_evaluation_environment(None) is not None


def test_a_batch_calls_its_observer_by_the_former_names():
    frames = []
    scorer = Scorer(TaskSpec(f"{__name__}:Former", "", 10, 0, ControllerShape(1, 8)))
    scorer.observer = FrameSampler(frames.append, lambda: True).for_group(3)
    assert scorer.score("score", np.zeros(16, np.float32), 1).fitness == 1.0
    assert [frame.group for frame in frames] == [3]


def test_a_world_takes_and_gives_its_former_fields():
    world = World(Toy.world.actions, stray="off_road", stray_cost=2.0)
    assert world == World(Toy.world.actions, off_course="off_road", off_course_cost=2.0)
    assert (world.stray, world.stray_cost) == ("off_road", 2.0)
    assert replace(world, stray_cost=3.0) == replace(world, off_course_cost=3.0)


@dataclasses.dataclass(frozen=True)
class FrozenFormer(Toy):
    width: int = 4


def test_a_frozen_task_is_found_by_its_former_names():
    assert found(FrozenFormer).batch_size == 4


def test_an_observer_of_former_names_observes():
    class Steps(list):
        def due(self):
            return True

        def see(self, episode, look):
            self.append(look().step)

    scorer = Scorer(TaskSpec("gym:CartPole-v1", "", horizon=3, patience=0, controller=ControllerShape(4, 2)))
    scorer.observer = Steps()
    scorer.score("score", np.zeros(10, np.float32), seed=1)
    assert scorer.observer == [0, 1, 2]


def test_a_subclass_of_world_takes_former_fields():
    @dataclasses.dataclass(frozen=True)
    class Marked(World):
        mark: int = 0

    world = Marked(Discrete(2), stray="off", stray_cost=1.0, mark=3)
    assert (world.off_course, world.stray_cost, world.mark) == ("off", 1.0, 3)
    assert dataclasses.replace(world, stray_cost=2.0).off_course_cost == 2.0
