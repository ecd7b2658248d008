"""Any gymnasium environment with pictures as a world in which data are recorded and world models are made.

Pages: own-world-model.md.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from typing import Annotated, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from msgspec import Meta
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.task_options import write_options
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.user_code import describe_error
from dreamfleet.common.protocol.tasks import GYM
from dreamfleet.common.schema.validation import OPTIONAL, MalformedError, from_plain, to_plain
from dreamfleet.worker.tasks import pictures
from dreamfleet.worker.tasks.api import Assignment, Driver, Policy, Task, World
from dreamfleet.worker.tasks.closing import close_environment
from dreamfleet.worker.tasks.drivers import HeldActions, UniformActions
from dreamfleet.worker.tasks.recordable import Preprocessing
from dreamfleet.worker.tasks.registry import preprocessing_for
from dreamfleet.worker.worldmodel.policy import ModelPolicy
from dreamfleet.worker.worldmodel.vae_config import SIDES
from dreamfleet.worker.worlds.gym import environments
from dreamfleet.worker.worlds.gym.spaces import make_converter, vector_actions

RENDERED = "render"  # as an observation: what the environment draws
EVERY_FRAME = "all"  # as an observation: all frames of the only picture, which is a stack


@dataclass(frozen=True)
class PixelOptions:
    """What is seen of an environment, and how long an action is held; `UsageError` for a value out of range.

    >>> PixelOptions.parse('{"crop": "0:400,0:640", "skip": 4}').rows_and_columns
    (0, 400, 0, 640)
    """

    environment: dict[str, Any] = field(default_factory=dict, metadata=OPTIONAL)  # arguments of `gymnasium.make`
    observation: Annotated[str, Meta(max_length=128)] = field(
        default="", metadata=OPTIONAL
    )  # a Dict's key, `render` or `all`
    crop: str = field(default="", metadata=OPTIONAL)  # `top:bottom,left:right`; empty: the whole picture
    size: int = field(default=SIDES[0], metadata=OPTIONAL)  # height and width
    skip: Annotated[int, Meta(ge=1, le=1000)] = field(default=1, metadata=OPTIONAL)  # steps for which an action is held
    difference: bool = field(default=False, metadata=OPTIONAL)  # show movement, in grey

    def __post_init__(self) -> None:
        if self.size not in SIDES:
            raise UsageError(f"pictures are {' or '.join(map(str, SIDES))} pixels wide, not {self.size}")
        if self.crop and self.rows_and_columns is None:
            raise UsageError(f"a crop is top:bottom,left:right, such as 0:400,0:640, not {self.crop!r:.50}")

    @classmethod
    def of(cls, arguments: Mapping[str, Any]) -> PixelOptions:
        """Those among a verb's arguments; one that is missing or `None` has its default."""
        known = {name: arguments.get(name) for name in cls.__dataclass_fields__}
        return cls.parse(json.dumps({name: value for name, value in known.items() if value is not None}))

    @classmethod
    def parse(cls, text: str) -> PixelOptions:
        """The options of a JSON object; an empty text has the defaults. `UsageError` for an unknown or wrong one."""
        try:
            plain = json.loads(text or "{}")
            if isinstance(plain, dict) and (unknown := sorted(set(plain) - set(cls.__dataclass_fields__))):
                raise MalformedError(f"there is no {', '.join(unknown)}")
            return from_plain(cls, plain)
        except (ValueError, RecursionError) as error:
            known = ", ".join(cls.__dataclass_fields__)
            raise UsageError(f"{text!r:.200} are not options of pictures ({error}); known are {known}") from error

    @property
    def text(self) -> str:
        """The options that differ from their defaults as canonical JSON; empty if none does."""
        return write_options(to_plain(self))

    @property
    def rows_and_columns(self) -> pictures.Crop | None:
        """The crop's first row, row after the last, first column and column after the last; `None`: no crop."""
        return pictures.parse_crop(self.crop)

    @property
    def preprocessing(self) -> str:
        """The name of its pictures."""
        crop = f"-{self.crop}" if self.crop else ""
        return f"box-{self.size}{crop}{'-difference' if self.difference else ''}"


class GymPixelTask(Task):
    """The task `gym:ENVIRONMENT` under options: its pictures, its actions as vectors, and drivers that draw these.

    Nothing is made before it is needed. `UsageError` where the environment has no such pictures or actions.

    >>> task = GymPixelTask.of("CartPole-v1", '{"observation": "render"}')
    >>> task.world.actions.outputs, list(task.preprocessings), list(task.drivers)
    (2, ['box-64'], ['held', 'uniform'])
    """

    def __init__(self, environment: str, options: PixelOptions) -> None:
        self.name = f"{GYM}:{environment}"
        self.options = options.text
        self._id, self._options = environment, options
        self._world: World | None = None  # until an environment was made

    @classmethod
    def of(cls, environment: str, options: str) -> GymPixelTask:
        """The task of an environment's id and options as `PixelOptions.parse` takes them; made once for each."""
        return _find(environment, PixelOptions.parse(options).text)

    @property
    def world(self) -> World:  # type: ignore[override]
        """The world of the environment's actions and registration.

        An environment is made for it only if none was before: many simulators allow one a process.
        """
        if self._world is None:
            close_environment(self._open())
        assert self._world is not None
        return self._world

    def _describe(self, made: gymnasium.Env[Any, Any], actions: Continuous) -> World:
        facts = environments.describe_environment(made, self._options.skip)
        meanings = environments.action_meanings(made)
        drawing = environments.distributions_of("pygame") if self._options.observation == RENDERED else ()
        packages = tuple(dict.fromkeys((*facts.pop("packages"), "onnxruntime", *drawing)))
        names = meanings if len(meanings) == actions.actions else ()
        return World(actions, packages, action_names=names, **facts)

    @cached_property
    def preprocessings(self) -> Mapping[str, Preprocessing]:
        """One: the pictures of the options; its `picture` takes one alone, in which nothing moves."""
        name, size, crop = self._options.preprocessing, self._options.size, self._options.rows_and_columns

        def picture(seen: NDArray[Any]) -> pictures.Pixels:
            small = pictures.cut_and_resize(pictures.tile_frames(seen) if self._tiles else seen, size, crop)
            return pictures.frame_difference(small, small) if self._options.difference else small

        return {name: Preprocessing(name, size, picture, mirrors=False)}

    @property
    def _tiles(self) -> bool:
        return self._options.observation == EVERY_FRAME

    @property
    def drivers(self) -> Mapping[str, Callable[[np.random.Generator], Driver]]:
        """Actions held for 1 to 10 steps, and another action at every step."""
        actions = self.world.actions
        assert isinstance(actions, Continuous)
        return {"held": partial(HeldActions, actions=actions), "uniform": partial(UniformActions, actions=actions)}

    def make_recorded(self, preprocessing: str) -> gymnasium.Env[Any, Any]:
        """A new environment that observes uint8 `(size, size, 3)` and takes float32 `(A,)`."""
        if preprocessing not in self.preprocessings:
            raise UsageError(f"{self.name} gives pictures {', '.join(self.preprocessings)}, not {preprocessing!r}")
        return self._open()

    def make_environment(self, assignment: Assignment, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """The same, which also draws in this render mode; `BundleError` if the world model is of other pictures."""
        preprocessing_for(assignment.world_model, self)
        return self._open(render_mode)

    make_evaluation_environment = make_environment

    def make_policy(self, assignment: Assignment) -> Policy:
        """The policy of the world model; `BundleError` if that is of other pictures."""
        preprocessing_for(assignment.world_model, self)
        return ModelPolicy(assignment.world_model)

    def _open(self, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        made = self._make(render_mode)
        try:
            wrapped = self._wrap(made)
            self._world = self._world or self._describe(made, wrapped.actions)
            return wrapped
        except BaseException:
            close_environment(made)
            raise

    def _make(self, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        if self._options.observation == RENDERED:
            if render_mode not in (None, environments.RGB):
                raise UsageError(f"{self._id} observes what it draws, so it draws nothing else: {render_mode!r}")
            render_mode = environments.RGB
        return environments.make_environment(self._id, self._options.environment, render_mode)

    def _wrap(self, made: gymnasium.Env[Any, Any]) -> pictures.VectorActions:
        options = self._options
        seen = self._choose_picture(pictures.SkipFrames(made, options.skip) if options.skip > 1 else made)
        small: gymnasium.Env[Any, Any] = pictures.CropAndResize(seen, options.size, options.rows_and_columns)
        if options.difference:
            small = pictures.FrameDifference(small)
        actions = vector_actions(made.action_space, self._id)
        return pictures.VectorActions(OneEnd(small), actions, make_converter(made.action_space, actions))

    def _choose_picture(self, environment: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
        space, wanted = environment.observation_space, self._options.observation
        entries = space.spaces if isinstance(space, spaces.Dict) else {"": space}
        keys = [key for key, each in entries.items() if pictures.is_picture(each)]
        only = keys[0] if len(keys) == 1 else None
        every = EVERY_FRAME if only is not None and "N" in pictures.find_axes(entries[only].shape or ()) else ""
        key = only if wanted in ("", every) else wanted
        if key is not None and key in keys:
            seen = environment
            if isinstance(space, spaces.Dict):
                seen = TransformObservation(environment, lambda observation: observation[key], entries[key])
            return _tile(seen, entries[key]) if self._tiles else seen
        if wanted == RENDERED:
            try:
                return pictures.LookAtDrawn(environment)
            except Exception as error:  # environments may raise anything
                raise UsageError(f"{self._id} draws no pictures: {describe_error(error)}") from error
        draws = environments.RGB in environment.metadata.get("render_modes", ())
        known = [each for each in (*keys, every) if each] + [RENDERED] * (draws and RENDERED not in keys)
        remedy = f"choose one with --observation: {', '.join(known)}" if known else "and it draws none"
        raise UsageError(
            f"{self._id} observes {space}, where {repr(wanted) if wanted else 'the picture'} is no picture or not the "
            f"only one: {remedy}. A picture is {pictures.KINDS}"
        )


def _tile(environment: gymnasium.Env[Any, Any], stack: Any) -> gymnasium.Env[Any, Any]:
    space = spaces.Box(pictures.tile_frames(stack.low), pictures.tile_frames(stack.high), dtype=stack.dtype)
    return TransformObservation(environment, lambda frames: pictures.tile_frames(np.asarray(frames)), space)


@lru_cache(maxsize=64)
def _find(environment: str, options: str) -> GymPixelTask:
    return GymPixelTask(environment, PixelOptions.parse(options))


class OneEnd(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Ends an episode for one reason: where a death and a limit come together, it is the limit."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """The environment's step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, bool(terminated and not truncated), bool(truncated), info
