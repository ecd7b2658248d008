"""Disturbed drives: noise and bursts on a policy's actions, so that data also show what follows unusual actions."""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import MOST_CHOICES, Continuous
from dreamfleet.worker.scoring.actors import Actor
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState

Floats = NDArray[np.float32]
CORRELATION = 0.9  # of the noise from step to step; at 50 steps a second it changes sign within about 0.2 s
SHORTEST, LONGEST = 3, 15  # steps of a burst or of another choice: 0.06 to 0.3 s at 50 steps a second
MEAN_LENGTH = (SHORTEST + LONGEST) / 2


class Disturbance:
    """What disturbs a drive, a pure function of the seed: noise on numbers, and sometimes another one of choices."""

    def __init__(self, seed: int, actions: Continuous, noise: float) -> None:
        """`noise` is the standard deviation, in halves of an action's range; of choices the share of steps pushed."""
        self._actions, self._random = actions, np.random.default_rng(seed)
        self._scale = noise * (np.array(actions.high) - np.array(actions.low)) / 2
        self._value = np.zeros(actions.actions)
        self._other: _OtherChoices | None = None
        if len(choices := numbered_choices(actions)):
            share = min(noise, 1.0)
            self._other = _OtherChoices(self._random, choices, share / (share + MEAN_LENGTH * (1 - share)))

    def next(self) -> Floats:
        """The push `(1, actions)` of the next step: noise, or the choice that replaces another; zeros: none.

        The noise is autoregressive, of first order.
        """
        if self._other is not None:
            return self._other.next()
        fresh = self._random.standard_normal(len(self._value))
        self._value = CORRELATION * self._value + (1 - CORRELATION**2) ** 0.5 * fresh
        push: Floats = (self._value * self._scale).astype(np.float32)[None]
        return push

    def apply(self, chosen: Floats, push: Floats) -> Floats:
        """The chosen actions under the `push`, as `add_disturbance`."""
        return add_disturbance(self._actions, chosen, push)


class _OtherChoices:
    """Sometimes a choice that is held for some steps, and zeros at the other steps."""

    def __init__(self, random: np.random.Generator, choices: Floats, chance: float) -> None:
        """`chance` is the probability, at each step without a choice, that one begins."""
        self._random, self._chance = random, chance
        self._choices = choices[choices.any(axis=1)]  # a row of zeros would be no push
        self._left = 0

    def next(self) -> Floats:
        """The choice `(1, actions)` of the next step, or zeros."""
        random = self._random
        begins, length = random.random(), int(random.integers(SHORTEST, LONGEST, endpoint=True))
        number = int(random.integers(len(self._choices)))
        if not self._left and begins < self._chance:
            self._left, self._choice = length, self._choices[number]
        if not self._left:
            return np.zeros_like(self._choices[:1])
        self._left -= 1
        choice: Floats = self._choice[None]
        return choice


@lru_cache
def numbered_choices(actions: Continuous) -> Floats:
    """Choices `(n, actions)` of numbered actions, which are rows of ones and zeros; none of other actions.

    Of groups they are at most `MOST_CHOICES`, spread over the numbers of each.
    """
    if actions.groups:
        most = max(actions.sizes)
        spread = np.linspace(0, most - 1, min(most, MOST_CHOICES)).astype(np.int64)
        return actions.from_numbers(spread[:, None] % np.array(actions.sizes))
    rows = np.array(actions.choices, np.float32).reshape(-1, actions.actions)
    return rows if np.isin(rows, (0, 1)).all() else rows[:0]


def add_disturbance(actions: Continuous, chosen: Floats, push: Floats) -> Floats:
    """The chosen actions `(rows, actions)` with the noise `push` added, within their bounds.

    An action that rests at a bound stays there; noise on an unused brake would slow down every drive. Of numbered
    choices the push replaces the chosen one, if it is not zero.
    """
    if len(numbered_choices(actions)):
        pushed: Floats = np.where(push.any(axis=1, keepdims=True), push, chosen)
        return pushed
    low, high = np.array(actions.low, np.float32), np.array(actions.high, np.float32)
    resting = (chosen <= low) | (chosen >= high)
    done: Floats = np.where(resting, chosen, np.clip(chosen + push, low, high))
    return done


class ActionBursts:  # `--spells` of docs/explanation/dreams.md and docs/lab/dreams-notes.md
    """Sometimes replaces an action that rests at a bound, which noise leaves alone, by a random value for some steps.

    Value and length of a burst are uniformly distributed. The bursts depend only on the seed and the chosen actions.
    Of numbered choices a burst is another choice.
    """

    def __init__(self, seed: int, actions: Continuous, chance: float) -> None:
        """`chance` is the probability, at each step and for each resting action, that a burst starts."""
        self._random, self._actions = np.random.default_rng([seed, 1]), actions
        choices = numbered_choices(actions)
        self._other = _OtherChoices(self._random, choices, chance) if len(choices) else None
        self._low, self._high = np.array(actions.low, np.float32), np.array(actions.high, np.float32)
        self._chance = chance
        self._value = np.zeros(actions.actions, np.float32)
        self._left = np.zeros(actions.actions, np.int64)

    def apply(self, chosen: Floats, done: Floats) -> Floats:
        """The next actions `(1, actions)`: those `done`, or bursts in their place; `chosen` are before any noise."""
        if self._other is not None:
            return add_disturbance(self._actions, done, self._other.next())
        random, count = self._random, len(self._value)
        begins, lengths = random.random(count), random.integers(SHORTEST, LONGEST, count, endpoint=True)
        values = random.uniform(self._low, self._high).astype(np.float32)
        resting = ((chosen <= self._low) | (chosen >= self._high))[0]
        new = (self._left == 0) & resting & (begins < self._chance)
        self._value, self._left = np.where(new, values, self._value), np.where(new, lengths, self._left)
        under = self._left > 0
        self._left -= under
        tried: Floats = np.where(under, self._value, done[0])[None]
        return tried


class DisturbedPolicy:
    """A policy: an actor chooses, the disturbance changes the action, and recurrent states get the changed action."""

    def __init__(
        self,
        actor: Actor,
        disturbance: Disturbance,
        watching: RecurrentState | None = None,
        bursts: ActionBursts | None = None,
    ) -> None:
        """`watching` is a recurrent state that observes the drive beside the actor's own, if any."""
        self._actor, self._disturbance, self._bursts = actor, disturbance, bursts
        states = [watching, None if actor.recurrent_state is watching else actor.recurrent_state]
        self._states = [each for each in states if each is not None]

    def begin(self, _parameters: Any = None) -> None:
        """Start an episode; the actor already has its parameters."""
        for each in self._states:
            each.begin()

    def act(self, observation: Any) -> Floats:
        """The disturbed action `(actions,)`."""
        for each in self._states:
            each.see(observation)
        push, chosen = self._disturbance.next(), self._actor.choose(observation)
        action = self._disturbance.apply(chosen, push)
        action = self._bursts.apply(chosen, action) if self._bursts else action
        self.on_action(action, push)
        for each in self._states:
            each.advance(action, chosen)
        done: Floats = action[0]
        return done

    def on_action(self, action: Floats, push: Floats) -> None:
        """Called with each action `(1, actions)` and its noise, before the recurrent states advance; for subclasses."""

    def reward(self, value: float) -> None:
        """Pass the reward of the last action to the recurrent states."""
        for each in self._states:
            each.reward(value)
