"""Measures of an episode beside its fitness: its length, what the controller did, and what the world reported.

docs/how-to/quality-diversity.md lists them. Components of actions have the names of the world's actions, else action0,
action1, ...; of a numbered action the measure is the share of steps that took it.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Actions, Discrete
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.measures import INFO, STEPS, TRUTH
from dreamfleet.worker.tasks.true_state import Truth

KINDS = ("", ".abs", ".share")  # of an action's measures, in the order of the tally's sums


class ActionTally:
    """Sums over the steps of what actions are, a row an episode; a row's bits do not depend on other rows."""

    def __init__(self, rows: int, actions: Actions) -> None:
        self._actions = actions
        self._sums = np.zeros((rows, len(KINDS), action_count(actions)))

    def add(self, rows: NDArray[np.intp], actions: Any) -> None:
        """Add a step: the actions `(rows, actions)` of these rows, or their numbers `(rows,)`."""
        values = np.asarray(actions, dtype=np.float64)
        if isinstance(self._actions, Discrete):
            numbers = values.astype(np.int64) - self._actions.first
            values = (numbers[..., None] == np.arange(self._actions.outputs)).astype(np.float64)
        self._sums[rows] += np.stack([values, np.abs(values), values > 0], axis=1)

    def mean(self, row: int, column: tuple[int, int], steps: int) -> float:
        """A measure's mean over the steps of a row."""
        return float(self._sums[row][column]) / steps


class Measurer:
    """Computes the measures of these `names` in a world with these actions; `UsageError` for an unknown one."""

    def __init__(
        self, names: Sequence[str], actions: Actions, action_names: Sequence[str], truth: Truth | None = None
    ) -> None:
        self.names, self.truth = tuple(names), truth
        self._actions = actions
        words = action_names or [f"action{number}" for number in range(action_count(actions))]
        self._columns = {
            f"{word}{kind}": (place, number) for number, word in enumerate(words) for place, kind in enumerate(KINDS)
        }
        for name in self.names:
            if name.startswith(TRUTH) and truth is None:
                raise UsageError(f"measure {name!r}: this task reports no true state")
            if name != STEPS and name not in self._columns and not name.startswith((INFO, TRUTH)):
                known = ", ".join((STEPS, *self._columns))
                raise UsageError(f"unknown measure {name!r}: known are {known}, info.KEY and truth.KEY")

    def begin(self, rows: int) -> ActionTally:
        """A tally for so many episodes."""
        return ActionTally(rows, self._actions)

    def values(self, tally: ActionTally, row: int, steps: int) -> tuple[float, ...]:
        """The measures of a tally's row, after so many steps."""
        return tuple(self.value(name, tally, row, steps) for name in self.names)

    def value(self, name: str, tally: ActionTally, row: int, steps: int) -> float:
        """The number of steps, or the measure of an action, of a tally's row."""
        return float(steps) if name == STEPS else tally.mean(row, self._columns[name], steps)


class EpisodeMeasurer:
    """Measures one episode in an environment."""

    def __init__(self, measurer: Measurer, environment: gymnasium.Env[Any, Any]) -> None:
        self._measurer, self._environment, self._tally = measurer, environment, measurer.begin(1)
        self._true_sums = {name.removeprefix(TRUTH): 0.0 for name in measurer.names if name.startswith(TRUTH)}
        self._info: dict[str, Any] = {}
        self._steps = 0

    def on_transition(self, action: Any, info: dict[str, Any]) -> None:
        """Add a step; `ValueError` if the task's true state lacks a number."""
        self._steps += 1
        self._tally.add(np.zeros(1, dtype=np.intp), np.asarray(action)[None])
        self._info = info
        if self._true_sums and self._measurer.truth is not None:
            state = self._measurer.truth(self._environment)
            for name in self._true_sums:
                self._true_sums[name] += _number(state, name, "task's true state")

    @property
    def values(self) -> tuple[float, ...]:
        """The measures of the episode; `ValueError` if the last `info` lacks a number."""
        return tuple(map(self._value, self._measurer.names))

    def _value(self, name: str) -> float:
        if name.startswith(INFO):
            return _number(self._info, name.removeprefix(INFO), "environment's last info")
        if name.startswith(TRUTH):
            return self._true_sums[name.removeprefix(TRUTH)] / self._steps
        return self._measurer.value(name, self._tally, 0, self._steps)


def action_count(actions: Actions) -> int:
    """Numbered actions, or components of a vector of actions."""
    return actions.outputs if isinstance(actions, Discrete) else actions.actions


def _number(values: dict[str, Any], name: str, where: str) -> float:
    try:
        return float(values[name])
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"the {where} has no number {name!r}, which the run measures") from None
