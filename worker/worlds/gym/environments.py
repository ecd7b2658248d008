"""Making an environment by the name and arguments of a task, and what it says of itself. Pages: trust.md."""

import re
import warnings
from collections.abc import Mapping
from contextlib import suppress
from enum import IntEnum
from importlib import import_module
from importlib.util import find_spec
from math import isfinite
from traceback import walk_tb
from typing import Any

import gymnasium
from gymnasium.envs import registration
from gymnasium.envs.registration import EnvSpec

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.foreign_code import contained
from dreamfleet.common.host.packages import GYMNASIUM, allow_swig_types, find_distributions
from dreamfleet.common.host.trusted_modules import check_trusted
from dreamfleet.common.host.unseen_drawing import draw_offscreen
from dreamfleet.common.host.user_code import describe_error, user_code
from dreamfleet.common.protocol.tasks import GYM
from dreamfleet.worker.tasks.api import ENVIRONMENT_LIMIT, World
from dreamfleet.worker.tasks.closing import close_environment

RGB = "rgb_array"  # gymnasium's render mode that returns pictures
_MODULE_PREFIX = re.compile(r"([^\s:]+):")  # of an environment's name
LONGEST_NAME = 128  # characters of an action's name, as a manifest holds it
FASTEST = 1000  # pictures a second, as a manifest holds them
DEFAULT_MAX_STEPS = 10_000  # steps of an episode, if the environment was registered without a limit
# Packages that gymnasium's own environments compute with. Other environments: the distribution of their module.
ENGINES = {
    "gymnasium.envs.box2d": ("box2d", "box2d-py"),
    "gymnasium.envs.mujoco": ("mujoco",),
    "gymnasium.envs.classic_control": (),
    "gymnasium.envs.toy_text": (),
}

# Packages whose environments gymnasium knows once they are imported: how a name begins, the distribution, its module.
# A name so begun imports that module where it is installed: this list chooses what is imported, and never the network.
PACKAGES = {
    "ALE/": ("ale-py", "ale_py"),
    "MiniGrid-": ("minigrid", "minigrid"),
    "dm_control/": ("'shimmy[dm-control]'", "shimmy"),
}

Environment = gymnasium.Env[Any, Any]


class ArgumentsError(UsageError):
    """The environment does not take the arguments that are given."""


def make_environment(name: str, arguments: Mapping[str, Any], render_mode: str | None = None) -> Environment:
    """The environment of gymnasium with this id; `UsageError` if it cannot be made, or draws no wanted pictures."""
    if render_mode is None:
        return _make(name, arguments)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*render_mode")  # gymnasium's: the error says it
            return _make(name, {**arguments, "render_mode": render_mode})
    except ArgumentsError as error:
        close_environment(_make(name, arguments))  # without pictures it is sound
        raise UsageError(
            f"{name} draws no pictures: it must take `render_mode`, and in the render mode {render_mode} its `render` "
            "must return an array (height, width, 3)"
        ) from error


def _make(name: str, arguments: Mapping[str, Any]) -> Environment:
    _check_arguments(f"{GYM}:{name}", arguments)
    if arguments.get("render_mode") == "human":
        raise UsageError(f"render_mode=human opens a window in every process that plays {name}: omit it")
    draw_offscreen()
    allow_swig_types()
    try:
        with contained(f"making {name}"), user_code(name.rpartition(":")[0] or name, f"making {name}"):
            if (known := _known_package(name)) and find_spec(known[1]):
                import_module(known[1])
            return gymnasium.make(_unregistered_class(name) or name, disable_env_checker=True, **arguments)
    except gymnasium.error.DependencyNotInstalled as error:
        raise UsageError(f"{name} lacks a package on this host: {error}") from error
    except (gymnasium.error.Error, ImportError) as error:
        if isinstance(error, ImportError) and (fault := _describe_import(name, error)):
            raise UsageError(fault) from error
        module, colon, _ = name.rpartition(":")
        remedy = "" if colon else f"; an environment of another package is written {GYM}:its_module:Its-v0"
        if known := _known_package(name):
            remedy = "" if find_spec(known[1]) else f"; install its package on this host: `pip install {known[0]}`"
        if colon and isinstance(error, ModuleNotFoundError):
            remedy = (
                f"; install the package of {module} on this host, or name its folder in PYTHONPATH, and trust it by "
                f"--trust {module}"
            )
        raise UsageError(f"gymnasium makes no environment {name!r} here ({error}){remedy}") from error
    except TypeError as error:
        if _is_of_call(error, arguments):
            raise ArgumentsError(f"{name} takes no such arguments: {error.__cause__}") from error
        raise UsageError(f"{name} cannot be made: TypeError: {error.__cause__ or error}") from error
    except UsageError:
        raise
    except Exception as error:  # environments may raise anything
        raise UsageError(f"{name} cannot be made: {describe_error(error)}") from error


def _known_package(name: str) -> tuple[str, str] | None:
    """The distribution and module of `PACKAGES` that have an environment of this name; `None` if none has."""
    return next((each for start, each in PACKAGES.items() if name.startswith(start)), None)


def _describe_import(name: str, error: ImportError) -> str:
    """Why an environment's package cannot be imported; empty if the package itself is missing."""
    if (error.name or "").partition(".")[0] == GYMNASIUM:
        return (
            f"{name} is of a package for another gymnasium than {gymnasium.__version__}, which is here ({error}): "
            "install a version of that package for this gymnasium, or mend its import (docs/reference/tasks.md)"
        )
    if not isinstance(error, ModuleNotFoundError):
        return f"{name} cannot be made: ImportError: {error}"
    if f"{name.rpartition(':')[0]}.".startswith(f"{error.name}."):
        return ""
    return (
        f"{name} needs the module {error.name!r}, which is not installed on this host: install the package that has it"
    )


def _is_of_call(error: TypeError, arguments: Mapping[str, Any]) -> bool:
    """Whether the call with these arguments raised it, and not what the constructor does with them.

    Gymnasium raises it again from that of its call. A function or subclass may hand arguments on: then the text names
    one of them.
    """
    cause = error.__cause__
    if not isinstance(cause, TypeError):
        return False
    places = [frame.f_code.co_filename for frame, _ in walk_tb(cause.__traceback__)]
    return places[-1] == registration.__file__ or any(
        f"unexpected keyword argument {name!r}" in str(cause) for name in arguments
    )


def _unregistered_class(name: str) -> EnvSpec | None:
    """The specification of `module:Class` where the module registers no environment of that name; else None."""
    module, colon, attribute = name.rpartition(":")
    if not colon:
        return None
    found = getattr(import_module(module), attribute, None)
    if not (isinstance(found, type) and issubclass(found, gymnasium.Env)):
        return None
    if any(attribute in (name, name.rpartition("-v")[0]) for name in gymnasium.registry):
        return None
    return EnvSpec(attribute, entry_point=name)


def _check_arguments(task: str, arguments: Any) -> None:
    """`UsageError` for an argument `module:Environment` of an untrusted module: some environments make others."""
    if isinstance(arguments, str) and (found := _MODULE_PREFIX.match(arguments)):
        check_trusted(found[1], f"argument {arguments!r:.100} of task {task!r}")
    if isinstance(arguments, Mapping):
        arguments = list(arguments.values())
    if isinstance(arguments, list):
        for each in arguments:
            _check_arguments(task, each)


def action_meanings(environment: Environment) -> tuple[str, ...]:
    """The names of an environment's numbered actions, if it has any.

    The Arcade Learning Environment returns them from a method. MiniGrid has an enumeration, of which some of its
    environments take the first ones.
    """
    found: Any = ()
    with suppress(Exception):  # environments may raise anything
        inner: Any = environment.unwrapped
        if isinstance(numbered := getattr(inner, "actions", None), type) and issubclass(numbered, IntEnum):
            taken: Any = environment.action_space
            found = tuple(numbered(number).name for number in range(taken.n))
        else:
            found = tuple(getattr(inner, "get_action_meanings", tuple)())
    are_names = all(type(each) is str and each.isprintable() and 0 < len(each) <= LONGEST_NAME for each in found)
    return found if are_names else ()


def describe_environment(environment: Environment, frames: int = 1) -> dict[str, Any]:
    """Fields of the environment's `World` that do not depend on its spaces; an action is held for `frames` steps."""
    spec, module = environment.spec, type(environment.unwrapped).__module__
    limit = (spec and spec.max_episode_steps) or DEFAULT_MAX_STEPS  # as standalone_play.py
    engine = next((packages for prefix, packages in ENGINES.items() if module.startswith(prefix)), None)
    said: Any = environment.metadata.get("render_fps")
    is_rate = isinstance(said, (int, float)) and isfinite(said) and said > 0
    rate = float(said if is_rate else World.frames_per_second)
    return {
        "packages": ("numpy", "gymnasium", *(distributions_of(module) if engine is None else engine)),
        "horizon": min(-(-limit // frames), ENVIRONMENT_LIMIT),
        "frames_per_second": min(max(1, round(rate / frames)), FASTEST),
        "threshold": spec.reward_threshold if spec else None,
        "judge": "gymnasium" if is_gymnasiums(environment) else "",
    }


def is_gymnasiums(environment: Environment) -> bool:
    """Whether gymnasium itself has this environment."""
    return type(environment.unwrapped).__module__.startswith(tuple(ENGINES))


def distributions_of(module: str) -> tuple[str, ...]:
    """The installed distributions that have a module; empty for a module of no distribution."""
    return tuple(sorted(set(find_distributions(module))))
