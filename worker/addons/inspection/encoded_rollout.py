"""A drive with the encoder's latents of its pictures, recorded anew in a bundle's world."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.foreign_code import answer_kept
from dreamfleet.common.printable import plural
from dreamfleet.common.runs.seeds import VALIDATION
from dreamfleet.worker.addons.inspection.subject import check_same_pictures
from dreamfleet.worker.scoring.disturbance import numbered_choices
from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.tasks.api import Assignment, Continuous, Policy, World
from dreamfleet.worker.tasks.closing import closing_environment
from dreamfleet.worker.tasks.model_free_policies import DriverPolicy
from dreamfleet.worker.tasks.recordable import RecordableTask
from dreamfleet.worker.tasks.registry import task_of
from dreamfleet.worker.worldmodel.inference import Encoder

Floats = NDArray[np.float32]
Pictures = NDArray[np.uint8]


@dataclass(frozen=True)
class DriveConfig:
    """The seed, the length and the driver of a drive."""

    seed: int = VALIDATION.start
    steps: int = 300
    action: tuple[float, ...] = ()  # repeated at each step instead of any driver's


@dataclass(frozen=True)
class EncodedRollout:
    """T steps: `picture` (T, side, side, 3) and its `mu`, `logvar` (T, latent); then `action` (T, A), `reward` (T,)."""

    picture: Pictures
    mu: Floats
    logvar: Floats
    action: Floats
    reward: NDArray[np.float64]
    description: str  # for captions
    opening: int = 0  # first steps that say little, such as while a camera moves
    died: bool = False  # whether the last action ended it

    def __len__(self) -> int:
        return len(self.action)

    @property
    def nats(self) -> Floats:
        """The information in each latent `(latent,)`: its mean KL divergence from the standard normal, in nats."""
        return np.asarray(self._divergence.mean(axis=0))

    @property
    def most_active(self) -> NDArray[np.int64]:
        """The latents' numbers `(latent,)`, the most informative first."""
        return np.argsort(-self.nats, kind="stable")

    @property
    def first_informative_step(self) -> int:
        """The step after the opening if the drive is long enough, else 0."""
        return self.opening if len(self) > self.opening else 0

    @property
    def most_informative_step(self) -> int:
        """The step with the largest KL divergence, of those of `first_informative_step`."""
        start = self.first_informative_step
        return start + int(self._divergence[start:].sum(axis=1).argmax())

    @property
    def _divergence(self) -> Floats:
        """The KL divergence of each latent at each step, in nats `(T, latent)`."""
        return np.asarray(0.5 * (self.mu**2 + np.exp(self.logvar) - self.logvar - 1))


class ConstantDriver:
    """A driver that repeats one action; `UsageError` if the world has no such action.

    One of numbered choices is given by its number, from 0, and several at once by the number of each.
    """

    def __init__(self, action: Sequence[float], world: World) -> None:
        actions, names = world.actions, world.action_names
        if isinstance(actions, Continuous) and len(numbered_choices(actions)):
            action = _choice_of(action, actions, names).tolist()
        done = np.array(action, np.float64)
        if not isinstance(actions, Continuous) or done.shape != (actions.actions,):
            numbers = f"{', '.join(names)}: {plural(len(names), 'number')}"
            wanted = numbers if names else "numbers, of a world with such actions"
            raise UsageError(f"--action takes {wanted}, not {_format_action(action)}")
        if not ((actions.low <= done) & (done <= actions.high)).all():
            ends = zip(names or count(1), actions.low, actions.high, strict=False)
            bounds = ", ".join(f"{name} from {low:g} to {high:g}" for name, low, high in ends)
            raise UsageError(f"--action takes {bounds}, not {_format_action(action)}")
        self._done = done.astype(np.float32)

    def act(self) -> Floats:
        """The action."""
        return self._done


def _choice_of(action: Sequence[float], actions: Continuous, names: Sequence[str]) -> Floats:
    sizes = actions.sizes
    if len(action) != len(sizes) or any(each not in range(size) for each, size in zip(action, sizes, strict=True)):
        named = len(sizes) == 1 and len(names) == sizes[0]
        numbered = ", ".join(f"{number} {name}" for number, name in enumerate(names)) if named else ""
        ranges = numbered or ", then ".join(f"0 to {size - 1}" for size in sizes)
        wanted = f"one number of a choice, {ranges}" if len(sizes) == 1 else f"{len(sizes)} numbers, {ranges}"
        raise UsageError(f"--action takes {wanted}, not {_format_action(action)}")
    return actions.from_numbers(np.array(action, np.int64))


def _format_action(action: Sequence[float]) -> str:
    return " ".join(f"{each:zg}" for each in action)


def record_drive(
    bundle: Bundle, controller: Controller | None, config: DriveConfig, own: Bundle | None = None
) -> EncodedRollout:
    """Drive one episode with `config.action`, else with the controller, else with the world's second random driver.

    `own` is the controller's world model if it differs from `bundle`, which encodes the drive.
    """
    if own is not None:
        check_same_pictures(own, bundle)
    assignment = Assignment.of(bundle.manifest.task, own or bundle)
    task, driver = task_of(bundle), "the controller"
    policy: Policy = task.make_policy(assignment)
    if config.action:
        driver = f"one action alone, {_format_action(config.action)}"
        policy = DriverPolicy(ConstantDriver(config.action, task.world_of(assignment)))
    elif controller is not None:
        policy.begin(controller.parameters)
    elif isinstance(task, RecordableTask):
        driver = "a random driver"
        policy = DriverPolicy(list(task.drivers.values())[1 % len(task.drivers)](np.random.default_rng(config.seed)))
    else:
        raise UsageError(f"task {bundle.manifest.task} has no driver: look at a run, whose controller drives")
    with closing_environment(task.make_environment(assignment)) as environment, answer_kept():  # the page follows
        moments = list(run_episode(environment, policy, EpisodeConfig(config.seed, config.steps)))
    seen = np.stack([moment.seen for moment in moments])
    mu, logvar = Encoder(bundle).encode(seen)
    actions, rewards = np.stack([moment.action for moment in moments]), np.array([each.reward for each in moments])
    opening = task.world_of(assignment).opening
    return EncodedRollout(
        seen, mu, logvar, actions, rewards, f"a fresh drive by {driver}", opening, moments[-1].terminal
    )
