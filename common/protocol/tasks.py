"""Looking up and loading tasks by name.

A name is one that a package registers in the entry-point group `dreamfleet.tasks`; a registered family with an argument
(`gym:LunarLander-v3`); or `module:attribute`, for an unregistered task. `gym:module:Environment-v0` and
`function:module:name` name a module too.
A name may come from a file or a message of somebody else, so only a trusted module is imported. Pages: trust.md.
"""

import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES
from dreamfleet.common.host.packages import GYMNASIUM, install_command_for, wrong_version
from dreamfleet.common.host.trusted_modules import check_trusted, find_attribute, import_trusted
from dreamfleet.common.host.user_code import user_code
from dreamfleet.common.printable import suggest
from dreamfleet.common.schema.display import DisplayedFields

GROUP = "dreamfleet.tasks"
_NAME = re.compile(r"[\w-][\w.-]*(:\S+)?", re.ASCII)
_ENVIRONMENT = re.compile(r"-v\d+$", re.ASCII)  # as the names of gymnasium's environments end
GYM = "gym"  # the family of gymnasium's environments; they need no bundle
FUNCTION = "function"  # the family of Python functions of a vector
ARGUMENTS = {GYM: "ENVIRONMENT", FUNCTION: "MODULE:NAME"}  # what stands behind a family's name: docs/reference/tasks.md
DREAM = "dream"  # the task whose candidates are scored in the world model


@dataclass(frozen=True, repr=False)
class Description(DisplayedFields):
    """The properties of a task without bundle that a run freezes.

    >>> from dreamfleet import Description
    >>> description = Description(observations=4, outputs=2)
    >>> description, description.version
    (Description(observations=4, outputs=2), 1)
    """

    observations: int  # inputs of a controller
    outputs: int  # of a controller
    packages: tuple[str, ...] = NUMERIC_PACKAGES  # packages whose versions may change a fitness
    version: int = 1
    options: str = ""  # canonical JSON
    steps: int = 0  # after which the environment itself ends an episode; 0: it has no limit, or none is known


def steps_word(task: str) -> str:
    """What a run's steps are: calls of a function, or steps of an environment.

    >>> steps_word("function:mine:cost"), steps_word("dream")
    ('evaluations', 'environment steps')
    """
    return "evaluations" if is_function_task(task) else "environment steps"


def step_unit(task: str) -> str:
    """The same in one word, for a speed or a table.

    >>> step_unit("function:mine:cost"), step_unit("dream")
    ('calls', 'steps')
    """
    return "calls" if is_function_task(task) else "steps"


def is_function_task(task: str) -> bool:
    """Whether a task is a Python function of a vector."""
    return task.partition(":")[0] == FUNCTION


def registered_tasks() -> dict[str, EntryPoint]:
    """The registered tasks and families by name."""
    return {point.name: point for point in sorted(entry_points(group=GROUP), key=lambda point: point.name)}


def family_of(name: str) -> str:
    """The name under which workers announce a task: the registered name or family, else the whole name."""
    return name if is_unregistered(name) else name.partition(":")[0]


def is_unregistered(name: str) -> bool:
    """Whether a task's name chooses a module to import, so that workers must name the task with `--task`."""
    return bool(module_of(name))


def module_of(name: str) -> str:
    """The module that a task's name makes a host import; empty if an installed package registers the task."""
    head, colon, rest = name.partition(":")
    if head == GYM:
        return rest.rpartition(":")[0]
    if head == FUNCTION:
        return rest.partition(":")[0]
    return head if colon and head not in registered_tasks() else ""


def check_task_trusted(name: str) -> None:
    """`UsageError` unless the module that a task's name chooses is trusted here.

    A loaded module may choose among gymnasium's environments: these are registered, or classes of environments.
    """
    module = module_of(name)
    if module and not (name.startswith(f"{GYM}:") and module in sys.modules):
        check_trusted(module, f"task {name!r}")


def load_task(name: str) -> Any:
    """Create the task of this name; `UsageError` if it is unknown or cannot be loaded."""
    points = registered_tasks()
    head, colon, rest = name.partition(":")
    try:
        if head in points:
            check_task_trusted(name)
            make = points[head].load()
            return make(rest) if colon else make()
        if colon:
            found = import_trusted(head, f"task {name!r}")
            with user_code(head, f"making task {name!r}"):
                return _task_class(found, rest)()
    except ModuleNotFoundError as error:
        remedy = install_command_for(error.name) or (
            "install the package that has it, or name its folder in PYTHONPATH: the current folder is not searched"
        )
        raise UsageError(f"task {name!r} cannot be loaded: no module {error.name!r} here; {remedy}") from error
    except Exception as error:
        remedy = wrong_version(GYMNASIUM)
        if not remedy and not isinstance(error, (ImportError, AttributeError, TypeError, ValueError)):
            raise
        raise UsageError(f"task {name!r} cannot be loaded: {error}{remedy and f'; {remedy}'}") from error
    check_task(name)
    known = ", ".join(map(written_name, points)) or "none"
    raise UsageError(f"unknown task {name!r}: known are {known}")


def written_name(name: str) -> str:
    """A registered name as people write it.

    >>> written_name("function"), written_name("dream")
    ('function:MODULE:NAME', 'dream')
    """
    return f"{name}:{ARGUMENTS[name]}" if name in ARGUMENTS else name


def _task_class(module: Any, name: str) -> Any:
    """A task's class in a module; `TypeError` for anything else, as the name may come from an untrusted file."""
    gymnasium, written = sys.modules.get("gymnasium"), f"{GYM}:{module.__name__}:{name}"
    if not hasattr(module, name) and (_ENVIRONMENT.search(name) or name in getattr(gymnasium, "registry", ())):
        raise AttributeError(f"{module.__name__} has no class {name}; write {written} if that is its environment")
    found = find_attribute(module, name)
    if not isinstance(found, type):
        raise TypeError(f"{name} of {module.__name__} is not a task: it is not a class")
    if issubclass(found, getattr(gymnasium, "Env", ())):
        raise TypeError(f"{name} of {module.__name__} is an environment of gymnasium and no task: write {written}")
    return found


def is_shipped(name: str) -> bool:
    """Whether this package has the task, or its family."""
    point = registered_tasks().get(name.partition(":")[0])
    return point is not None and point.dist is not None and point.dist.name == "dreamfleet"


def is_self_describing(name: str) -> bool:
    """Whether a task needs no bundle; `UsageError` if the task cannot be loaded here."""
    if name.partition(":")[0] in ARGUMENTS:
        return True
    try:
        return callable(getattr(load_task(name), "describe", None))
    except UsageError as error:
        if isinstance(error.__cause__, (AttributeError, TypeError)):
            raise  # its module is here
        raise UsageError(f"{error}; if only workers have it, name its world model with --bundle") from error


def check_task(name: str) -> None:
    """`UsageError` for an invalid task name, or one that nearly is a registered name."""
    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{name!r} cannot name a task: give a registered name, {GYM}:ENVIRONMENT, {written_name(FUNCTION)}, or "
            "module:attribute"
        )
    points = registered_tasks()
    head, colon, _ = name.partition(":")
    if head in points or "." in head:
        return
    if same := [each for each in points if _plain(each) == _plain(head)]:
        raise UsageError(f"unknown task {name!r}: it is written {same[0]} here")
    if not colon and _ENVIRONMENT.search(name):
        raise UsageError(f"unknown task {name!r}: gymnasium's environments are written {GYM}:{name}")
    if near := suggest(head, points, likeness=0.75, listed=False):
        raise UsageError(f"unknown task {name!r}{near}")


def _plain(name: str) -> str:
    """A name without what people write differently.

    >>> _plain("CarRacing-v3") == _plain("car-racing")
    True
    """
    return re.sub(r"[-_]", "", _ENVIRONMENT.sub("", name)).lower()


def describe_task(name: str, options: Mapping[str, Any]) -> Description:
    """The description of a task that needs no bundle; `UsageError` for a task without one.

    Only the host that starts the run and the workers need the task's package.
    """
    task = load_task(name)
    if not callable(getattr(task, "describe", None)):
        raise UsageError(f"task {name!r} needs a world model: give one with --bundle")
    description: Description = task.describe(options)
    return description
