"""What a scored seed is called in reports, a track or a game, and what a score counts. Pages: worlds.md."""

from contextlib import suppress
from pathlib import Path

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.worlds.profile import WorldProfile
from dreamfleet.common.worlds.shipped import WORLDS


def profile_of(task: str) -> WorldProfile:
    """The profile of a task's world; without one, what any world has.

    >>> profile_of("takecover").format_score(836)
    '836 tics survived (24 s)'
    """
    return WORLDS.get(task) or WorldProfile(task=task)


def score_word(task: str) -> str:
    """What a scored seed is called in the world of `task`, where no bundle describes it.

    >>> score_word("car-racing"), score_word("gym:CartPole-v1")
    ('track', 'seed')
    """
    return WORLDS[task].score_word if task in WORLDS else WorldProfile.score_word


def score_word_of_run(spec: TaskSpec, bundle: Path) -> str:
    """What a scored seed of a run's evaluations is called; `bundle` is the run's copy of its world model, if any."""
    if spec.bundle:
        with suppress(DreamfleetError, OSError):  # it may be gone
            return Bundle.open(bundle, spec.bundle).manifest.world.score_word
    return score_word(spec.task)
