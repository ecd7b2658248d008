"""Optional: a task that can hide from its pictures what decides an episode, so that blind policies are told apart."""

from typing import Any, Protocol, runtime_checkable

import gymnasium

from dreamfleet.worker.tasks.api import Assignment


@runtime_checkable
class TaskWithMask(Protocol):  # docs/reference/worlds.md
    """A task whose evaluation environment can be had with changed pictures and the same episodes.

    A controller that looks loses by both changes; one that moves by habit loses by neither. `dreamfleet evaluate
    --blind` measures it.
    """

    def make_masked_environment(self, assignment: Assignment, *, foreign: bool) -> gymnasium.Env[Any, Any]:
        """The evaluation environment with what decides painted out; if `foreign`, with another episode's instead."""
