"""A dry run of a task before a run begins in it: its environment is made, reset and stepped. Called as a process.

`common/addons/task_check/task_check.py` starts it, because an environment may hang or crash. It reads a request
from stdin and writes lines of JSON: a step's name before each step, to which a limit applies, and reports, of which
the last counts. Pages: tasks.md, own-environment.md, unattended.md.
"""

import json
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from time import monotonic
from typing import Any, cast

from dreamfleet.common.addons.task_check.task_check import LAST_STEP, LEAVE_OPEN, DryRunReport
from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.host.unseen_drawing import draw_unseen
from dreamfleet.common.host.user_code import describe_error, keep_user_arguments
from dreamfleet.common.printable import one_line, plural
from dreamfleet.common.protocol.tasks import Description, describe_task

MEND = "fix the environment, or wrap it"
SLOW_RESET = 2.0  # seconds; gymnasium's checker resets a dozen times, so it is left out where resets are slower
CORNERS = 4  # random corners of the actions that are tried
SATURATED = 1000.0  # an output so large that its action is a bound
MAX_ACTION = 100  # characters of an action in a message
ADVICE = re.compile(r"infinity|we recommend")  # warnings of gymnasium's checker that are about style
COLOURS = re.compile(r"\x1b\[\d+m|WARN: ")


class FaultError(Exception):
    """The environment cannot be scored; the text says why."""


@dataclass
class CheckedEnvironment:
    """An environment whose answers are checked as the episode loop gets them."""

    environment: Any
    observations: int
    announce: Callable[[str], None]
    first: Any = None  # the first observation since the last reset
    warnings: list[str] = field(default_factory=list)
    reset_seconds: float = 0.0

    def reset(self, *, seed: int) -> Any:
        """Reset it; `FaultError` unless it gives a finite observation of the right size, and its info."""
        self.announce(f"reset(seed={seed})")
        began = monotonic()
        answer = self.environment.reset(seed=seed)
        self.reset_seconds = monotonic() - began
        self.announce("its first steps")
        if not (isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[1], Mapping)):
            raise FaultError(
                f"its reset returns {_describe(answer)}, not an observation and a dictionary: that is the API from "
                f"before gymnasium 0.26; {MEND}"
            )
        self.first = answer[0]
        if not self._check_observation(self.first):
            raise FaultError(f"its first observation holds NaN or infinity; {MEND}")
        return answer

    def step(self, action: Any) -> Any:
        """Step it; `FaultError` unless it gives five values with one finite number as the reward."""
        try:
            answer = self.environment.step(action)
        except (ValueError, TypeError):  # gymnasium's wrappers fail where the environment's own answer is malformed
            _check_step(self.environment.unwrapped.step(action))
            raise
        _check_step(answer)
        self._check_observation(answer[0])
        return answer

    def _check_observation(self, observation: Any) -> bool:
        import numpy as np

        if np.size(observation) != self.observations:
            raise FaultError(
                f"its observation is {_describe(observation)}, but its observation space has {self.observations} "
                f"numbers; {MEND}"
            )
        numbers = np.asarray(observation, dtype=np.float64)
        finite = bool(np.isfinite(numbers).all())
        if not finite:
            text = "an observation holds NaN or infinity, from which no controller can act"
        elif (np.abs(numbers) > np.finfo(np.float32).max).any():
            text = "an observation holds a number beyond 3.4e38, infinite in the single precision of controllers"
        else:
            return True
        if text not in self.warnings:
            self.warnings.append(text)
        return finite


def _check_step(answer: Any) -> None:
    import numpy as np

    if not isinstance(answer, tuple) or len(answer) != 5:
        raise FaultError(
            f"its step returns {_describe(answer)}, not five values (observation, reward, terminated, truncated, "
            f"info): that is the API from before gymnasium 0.26; {MEND}"
        )
    reward = answer[1]
    if np.ndim(reward) or not isinstance(np.asarray(reward).item(), (bool, int, float)):
        raise FaultError(f"its reward is {_describe(reward)}, not one number; {MEND}")
    if not np.isfinite(float(reward)):
        raise FaultError(f"its reward is {float(reward)}, not a finite number; {MEND}")


def _describe(value: Any) -> str:
    if isinstance(value, tuple):
        return f"{plural(len(value), 'value')}"
    shape = getattr(value, "shape", None)
    return f"an array of shape {shape}" if shape else f"a value of type {type(value).__name__}"


def dry_run(
    name: str,
    options: Mapping[str, Any],
    announce: Callable[[str], None],
    *,
    thorough: bool,
    measures: Sequence[str] = (),
) -> Iterator[DryRunReport]:
    """Describe the task, drive its probe episode, and yield what was found.

    `thorough`: drive the episode twice and normalise, then yield again with what gymnasium's checker says.
    `UsageError` if the task cannot be described or lacks one of `measures`, `FaultError` if its environment cannot be
    scored.
    """
    announce("making it")
    description = describe_task(name, {key: value for key, value in options.items() if key != "normalise"})
    from dreamfleet.worker.scoring.host_class_probe import REPEAT_LIMIT  # needs gymnasium, as the task may not
    from dreamfleet.worker.tasks import closing

    trial = _Trial(name, description, announce, measures)
    checked = trial.checked
    began = monotonic()
    report = DryRunReport(description, episode=trial.drive(), first=_digest(checked.first))
    report.seconds = monotonic() - began
    if thorough and report.episode and report.seconds < REPEAT_LIMIT:
        report.repeated = trial.drive()
    if thorough:
        trial.drive_extremes()
        checked.warnings += _describe_pictures(name, checked.environment)
        checked.warnings += _describe_left_out(checked.environment)
        if checked.reset_seconds >= SLOW_RESET:
            checked.warnings.append(f"a reset took {checked.reset_seconds:.0f} s, so gymnasium's checker was left out")
    if thorough and options.get("normalise"):
        closing.close_environment(checked.environment)  # many simulators allow one a process, and this makes another
        announce("")
        report.description = describe_task(name, options)
        announce("making it")
        checked.environment = trial.make()
    report.warnings = tuple(checked.warnings)
    yield report
    if thorough and checked.reset_seconds < SLOW_RESET:
        announce("gymnasium's checker")
        report.warnings = (*checked.warnings, *_check_by_gymnasium(checked.environment))
        yield report
    announce(LAST_STEP)
    if fault := closing.close_environment(checked.environment):
        report.warnings, report.close_hangs = (*report.warnings, fault), closing.has_hung()
        yield report


class _Trial:
    """A task's environment under its policy."""

    def __init__(
        self, name: str, description: Description, announce: Callable[[str], None], measures: Sequence[str]
    ) -> None:
        from dreamfleet.common.artifacts.controller import ControllerShape
        from dreamfleet.common.protocol.messages import TaskSpec
        from dreamfleet.worker.tasks.api import Assignment
        from dreamfleet.worker.tasks.measures import Measurer
        from dreamfleet.worker.tasks.registry import find_task

        task, shape = find_task(name), ControllerShape(description.observations, description.outputs)
        assignment = Assignment(
            TaskSpec(name, "", 1000, 0, shape, options=description.options, version=description.version)
        )
        world = task.world_of(assignment)
        Measurer(measures, world.actions, world.action_names, getattr(task, "truth", None))
        self.make: Callable[[], Any] = lambda: task.make_environment(assignment)  # its environment anew
        self.checked = CheckedEnvironment(self.make(), description.observations, announce)
        self._policy, self._actions = task.make_policy(assignment), world.actions
        self._size, self._probe_steps = shape.size, task.probe_steps

    def drive(self) -> str:
        """Drive the probe episode and return its digest; empty: there is none."""
        from dreamfleet.worker.scoring.host_class_probe import HostClassProbe

        if self._probe_steps <= 0:
            return ""
        probe, environment = HostClassProbe(), cast("Any", self.checked)
        probe.add_episode(environment, self._policy, self._size, self._probe_steps)
        return probe.host_class

    def drive_extremes(self) -> None:
        """Step with both bounds and random corners of the actions, as controllers with large outputs do."""
        import numpy as np

        from dreamfleet.worker.tasks.model_free_policies import FlatPolicy

        if not isinstance(self._policy, FlatPolicy) or not getattr(self._actions, "squashed", True):
            return  # others may take other outputs, and those without tanh have no bounds
        size, is_over, slow_resets = self._actions.outputs, True, False
        corners = np.random.default_rng(0).choice([-1.0, 1.0], (CORNERS, size))
        last = np.arange(size) == size - 1  # of numbered actions
        for signs in (np.full(size, -1.0), np.full(size, 1.0), np.where(last, 1.0, -1.0), *corners):
            if is_over and slow_resets:
                return
            if is_over:
                self.checked.reset(seed=0)
                slow_resets = self.checked.reset_seconds >= SLOW_RESET
            action = self._actions.to_action((SATURATED * signs).astype(np.float32))
            self.checked.announce(f"a step with the action {one_line(str(action))[:MAX_ACTION]}")
            _, _, terminated, truncated, _ = self.checked.step(action)
            is_over = bool(terminated or truncated)


def _digest(value: Any) -> str:
    from dreamfleet.worker.scoring.host_class_probe import HostClassProbe

    probe = HostClassProbe()
    probe.add_value(value)
    return probe.host_class


def _check_by_gymnasium(environment: Any) -> list[str]:
    """What gymnasium's own checker finds in an environment that does not come with gymnasium."""
    import gymnasium
    from gymnasium.utils.env_checker import check_env

    own = environment.unwrapped
    if not isinstance(own, gymnasium.Env) or type(own).__module__.startswith(("gymnasium.envs.", "dreamfleet.")):
        return []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            check_env(own, skip_render_check=True, skip_close_check=True)
            found = []
        except (Exception, SystemExit) as error:  # environments may raise anything
            found = [str(error) or type(error).__name__]
    texts = [COLOURS.sub("", str(each.message)) for each in caught if issubclass(each.category, UserWarning)]
    return [f"gymnasium's checker: {one_line(text)}" for text in [*found, *texts] if not ADVICE.search(text)]


def _describe_pictures(name: str, environment: Any) -> list[str]:
    from dreamfleet.worker.tasks.pictures import is_picture

    found = []
    for key, space in _observed(environment).items():
        if is_picture(space):
            where, seen = (f" as {key!r}", ("--observation", key)) if key else ("", ())
            found.append(
                f"it observes pictures of shape {tuple(space.shape)}{where}, and the controller has a weight for each "
                f"value: a world model makes few numbers of them (`{shell_command('pipeline', '--task', name, *seen)}`)"
            )
    return found


def _observed(environment: Any) -> dict[str, Any]:
    """The spaces that a controller sees: those of a Dict by their keys, before it is flattened, or the only one."""
    from gymnasium import Wrapper
    from gymnasium.spaces import Dict

    each = environment
    while isinstance(each, Wrapper) and not isinstance(each.observation_space, Dict):
        each = each.env
    seen = each.observation_space
    return dict(seen.spaces) if isinstance(seen, Dict) else {"": environment.observation_space}


def _describe_left_out(environment: Any) -> list[str]:
    found = getattr(environment, "has_wrapper_attr", None)
    if found is None or not found("left_out") or not (names := environment.get_wrapper_attr("left_out")):
        return []
    return [f"no numbers, and left out of what the controller sees: {', '.join(names)}"]


def _load_and_wait(go: int) -> bytes:
    """Import what any dry run needs, and wait until a word comes or the descriptor `go` is closed elsewhere."""
    with suppress(Exception):  # the dry run reports it
        import dreamfleet.worker.scoring.host_class_probe
        import dreamfleet.worker.tasks.registry  # noqa: F401
    word = os.read(go, 1)
    os.close(go)
    return word


def main() -> None:
    """Answer the request on stdin; whatever the environment prints goes to stderr."""
    request = json.load(sys.stdin)
    sys.path[:] = request["path"]
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    draw_unseen()
    pin_thread_pools()
    if _load_and_wait(int(sys.argv[1])) == LEAVE_OPEN:
        from dreamfleet.worker.tasks import closing

        closing.leave_open()
    keep_user_arguments()
    step = "loading it"

    def announce(name: str) -> None:
        nonlocal step
        step = name
        print(json.dumps({"step": name}), file=out, flush=True)

    def send(found: DryRunReport) -> None:
        print(json.dumps({"report": asdict(found)}, default=int), file=out, flush=True)

    name = request["task"]
    try:
        for found in dry_run(
            name, request["options"], announce, thorough=request["thorough"], measures=request["measures"]
        ):
            send(found)
    except DreamfleetError as error:
        send(DryRunReport(fault=one_line(str(error) if isinstance(error, UsageError) else f"{name}: {error}")))
    except FaultError as error:
        send(DryRunReport(fault=f"{name} cannot be scored: {error}"))
    except (Exception, SystemExit) as error:  # environments may raise anything
        send(DryRunReport(fault=f"{name} cannot be scored: {step} raised {describe_error(error)}; {MEND}"))
    os._exit(0)  # what the environment left running must not keep it


if __name__ == "__main__":
    main()
