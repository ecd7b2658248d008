"""What holds of every task in whose world data are recorded."""

import numpy as np

from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.tasks.api import Continuous
from dreamfleet.worker.tasks.model_free_policies import DriverPolicy
from dreamfleet.worker.tasks.recordable import RecordableTask

STEPS = 40
SEED = 2**53 - 1  # the longest


def check_world(task, steps=STEPS):
    """Assert the contract of a `RecordableTask` by driving in each of its pictures.

    Drives have `steps` steps at most; after that many, two seeds must differ.
    """
    assert isinstance(task, RecordableTask)
    assert isinstance(task.name, str)
    assert isinstance(task.world.actions, Continuous)
    assert {"numpy", "onnxruntime"} <= set(task.world.packages)
    assert task.drivers
    assert task.preprocessings
    for name in task.drivers:
        check_driver(task, name)
    check_mirror(task)
    for name, preprocessing in task.preprocessings.items():
        assert preprocessing.name == name
        assert len(name) <= 128
        assert preprocessing.size in (64, 96)
        check_drives(task, preprocessing, steps)


def check_driver(task, name):
    """A driver gives actions of the world, the same ones from the same random numbers."""
    one, other = (task.drivers[name](np.random.default_rng(7)) for _ in range(2))
    for _ in range(100):
        action = one.act()
        check_action(task.world.actions, action)
        assert (action == other.act()).all()


def check_action(actions, action):
    """An action is a float32 vector `(A,)` within the bounds, and one of the choices if there are any."""
    assert action.shape == (actions.actions,)
    assert action.dtype == np.float32
    assert ((np.float32(actions.low) <= action) & (action <= np.float32(actions.high))).all()
    if actions.choices:
        assert actions.to_outputs(action).sum() == 1


def check_mirror(task):
    """A mirrored action is an action too, and the mirror's mirror is the action."""
    mirror = task.world.mirror
    driver = next(iter(task.drivers.values()))(np.random.default_rng(1))
    for action in (driver.act() for _ in range(20 if mirror else 0)):
        check_action(task.world.actions, mirror.apply(action))
        assert (mirror.apply(mirror.apply(action)) == action).all()


def check_drives(task, preprocessing, steps):
    """Drives of one seed are equal, in one environment or two, after others too; those of another seed differ."""
    drives = []
    for seeds in ((5, SEED, 5), (SEED,)):
        environment = task.make_recorded(preprocessing.name)
        assert environment.observation_space.shape == preprocessing.shape
        assert environment.observation_space.dtype == np.uint8
        try:
            drives += [drive(task, environment, preprocessing, seed, steps) for seed in seeds]
        finally:
            environment.close()
    five, longest, five_again, longest_again = drives
    assert five == five_again
    assert longest == longest_again
    assert five != longest


def drive(task, environment, preprocessing, seed, steps):
    """The bytes of all pictures and rewards of a short drive."""
    policy = DriverPolicy(next(iter(task.drivers.values()))(np.random.default_rng(3)))
    taken = []
    for moment in run_episode(environment, policy, EpisodeConfig(seed, steps)):
        assert moment.seen.shape == preprocessing.shape
        assert moment.seen.dtype == np.uint8
        check_action(task.world.actions, moment.action)
        assert np.isfinite(moment.reward)
        assert moment.ended or not moment.terminal
        taken.append((moment.seen.tobytes(), moment.reward, moment.ended, moment.terminal))
    return taken
