"""Train your own agent: a double DQN that learns only in the dream and is evaluated on real tracks.

    python docs/tutorials/own_agent.py --steps 3000000 --episodes 32

It chooses one of gymnasium's five CarRacing actions and holds it for four steps. It observes [z, h], since the latent z
alone does not show the car's speed. Needs `pip install '.[train]'`.
"""

import argparse
import os
import time
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from torch import Tensor, nn

from dreamfleet.common.artifacts.actions import FIVE_CHOICES
from dreamfleet.common.runs.seeds import validation_seeds
from dreamfleet.common.runs.standard_error import format_with_error, standard_error

DREAM = "dreamfleet.worker.dream:dreamfleet/CarRacingDream-v0"
REALITY = "dreamfleet.worker.worlds.car_racing:dreamfleet/CarRacingLatent-v0"
ACTIONS = np.array(FIVE_CHOICES.choices, np.float32)  # nothing, right, left, gas, brake
HOLD = 4  # steps
DREAMS, HORIZON, TEMPERATURE = 64, 400, 1.25  # parallel dreams; steps; above 1, dreams are harder to exploit
BATCH, REPLAY, UPDATES, RATE, GAMMA, FOLLOW = 256, 300_000, 2, 3e-4, 0.98, 0.005
LEAST, SETTLED = 0.05, 0.3  # final share of random choices, and the fraction of training until it is reached
FIRST, REPORT = 2560, 1000  # choices before learning starts; choices in each dream between reports


class Held(NamedTuple):
    """The outcome of a held choice, a row for each world."""

    after: Any  # observations at the end of the choice, or of the episode if that ended first
    reward: Any
    failed: Any  # the world ended the episode, not the horizon
    over: Any
    now: Any  # current observations; of the next episode if one ended early
    last: Any  # the episode ended at the last step: the next choice only resets the world


def hold(worlds: gymnasium.vector.VectorEnv[Any, Any, Any], choices: Any) -> Held:
    """Hold `choices` `(N,)` for `HOLD` steps."""
    reward, failed, over = (np.zeros(worlds.num_envs, kind) for kind in (float, bool, bool))
    after = np.zeros(worlds.observation_space.shape or (), np.float32)
    for _ in range(HOLD):
        now, given, terminated, truncated, _ = worlds.step(ACTIONS[choices])
        after[~over] = now[~over]
        reward[~over] += given[~over]
        failed |= terminated & ~over
        last = terminated | truncated
        over |= last
    return Held(after, reward, failed, over, now, last)


def make_network(inputs: int) -> nn.Module:
    """A network from observations `(N, inputs)` to the value of each choice `(N, 5)`."""
    layers = nn.Linear(inputs, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, len(ACTIONS))
    return nn.Sequential(nn.LayerNorm(inputs), *layers)


def best(network: nn.Module, seen: Any) -> Any:
    """The choices with the highest value `(N,)`."""
    with torch.no_grad():
        return network(torch.from_numpy(seen)).argmax(dim=1).numpy()


def loss_of(network: nn.Module, target: nn.Module, batch: Sequence[Tensor]) -> Tensor:
    """The Huber loss of double Q-learning: the target network values the network's choice (van Hasselt 2016)."""
    seen, choices, rewards, goes_on, after = batch
    with torch.no_grad():
        worth = target(after).gather(1, network(after).argmax(dim=1, keepdim=True))[:, 0]
    predicted = network(seen).gather(1, choices[:, None])[:, 0]
    return nn.functional.smooth_l1_loss(predicted, rewards + GAMMA * goes_on * worth)


def learn(dreams: gymnasium.vector.VectorEnv[Any, Any, Any], steps: int, seed: int) -> nn.Module:
    """Train a network on `steps` dreamt steps."""
    random, size = np.random.default_rng(seed), dreams.single_observation_space.shape or (0,)
    network = make_network(*size)
    target, optimiser = deepcopy(network), torch.optim.Adam(network.parameters(), RATE)
    kinds = (size, np.float32), ((), np.int64), ((), np.float32), ((), np.float32), (size, np.float32)
    replay = [np.zeros((REPLAY, *shape), kind) for shape, kind in kinds]
    rounds = max(steps // (DREAMS * HOLD), 1)
    kept, began = 0, time.monotonic()
    earned: list[float] = []
    seen, _ = dreams.reset(seed=seed)
    begun = np.ones(DREAMS, bool)
    for done in range(1, rounds + 1):
        chance = max(1 - (1 - LEAST) * (done - 1) / (SETTLED * rounds), LEAST)
        anything = random.integers(len(ACTIONS), size=DREAMS)
        choices = np.where(random.random(DREAMS) < chance, anything, best(network, seen))
        held = hold(dreams, choices)
        places = (kept + np.arange(begun.sum())) % REPLAY
        moment = seen, choices, held.reward / 10, ~held.failed, held.after
        for column, values in zip(replay, moment, strict=True):
            column[places] = values[begun]
        seen, begun, kept = held.now, ~held.last, kept + len(places)
        for _ in range(UPDATES if kept >= FIRST else 0):
            rows = random.integers(min(kept, REPLAY), size=BATCH)
            optimiser.zero_grad()
            loss_of(network, target, [torch.from_numpy(column[rows]) for column in replay]).backward()
            optimiser.step()
            with torch.no_grad():
                for slow, fast in zip(target.parameters(), network.parameters(), strict=True):
                    slow.lerp_(fast, FOLLOW)
        earned.append(held.reward.mean() / HOLD)
        if done % REPORT == 0 or done == rounds:
            mean = np.mean(earned)
            earned.clear()
            progress = f"{done * DREAMS * HOLD} steps, {time.monotonic() - began:.0f} s"
            print(f"{progress}: {mean:.3f} a dreamt step", flush=True)
    return target


def judge(tracks: gymnasium.vector.VectorEnv[Any, Any, Any], choose: Callable[[Any], Any], seed: int) -> float:
    """The score of a whole real episode; `tracks` has one world."""
    seen, _ = tracks.reset(seed=seed)
    score, over = 0.0, False
    while not over:
        held = hold(tracks, choose(seen))
        seen, score, over = held.now, score + held.reward[0], held.over[0]
    return score


def main() -> None:
    """Train, then evaluate beside an agent that chooses at random."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--steps", type=int, default=3_000_000, help="dreamt steps to train for (default 3000000)")
    parser.add_argument("--episodes", type=int, default=32, help="real tracks to evaluate on (default 32)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the training (default 0)")
    parser.add_argument("--bundle", default="tiny", help="world model: a file or a shipped name (default tiny)")
    args = parser.parse_args()
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # open no window
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)
    both = {"bundle": args.bundle, "features": "zh"}
    dreams = gymnasium.make_vec(DREAM, DREAMS, "vector_entry_point", horizon=HORIZON, temperature=TEMPERATURE, **both)
    network = learn(dreams, args.steps, args.seed)
    tracks, random = gymnasium.make_vec(REALITY, 1, native=True, **both), np.random.default_rng(args.seed)
    agents: dict[str, Callable[[Any], Any]] = {
        "learnt": lambda seen: best(network, seen),
        "random": lambda _: random.integers(len(ACTIONS), size=1),
    }
    for name, choose in agents.items():
        scores = np.array([judge(tracks, choose, seed) for seed in validation_seeds(args.episodes)])
        if len(scores) == 1:
            print(f"{name}: {scores[0]:.1f} on one real track", flush=True)
            continue
        score = format_with_error(scores.mean(), standard_error(scores.tolist()))
        summary = f"{score} on {len(scores)} real tracks"
        print(f"{name}: {summary} ({scores.min():.0f} to {scores.max():.0f})", flush=True)
    tracks.close()


if __name__ == "__main__":
    main()
