"""Play an environment by `controller.npz` beside this file: `python drive.py 10000` prints the score of that seed.

pip install gymnasium numpy
"""

import json
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

with np.load(Path(__file__).with_name("controller.npz")) as file:
    about, parameters = json.loads(str(file["about"])), file["parameters"]
shape, options = about["shape"], json.loads(about.get("options") or "{}")
normal = options.get("normal", {"mean": 0.0, "deviation": 1.0})
mean, scale = np.float32(normal["mean"]), np.float32(1) / np.float32(normal["deviation"])
widths = [shape["features"], *([shape["hidden"]] if shape.get("hidden") else []), shape["actions"]]


def outputs(observation: Any) -> np.ndarray:
    """The controller's sums for an observation: linear, or with a layer of tanh units between."""
    value, start = (np.float32(observation).reshape(-1) - mean) * scale, 0
    for inputs, units in pairwise(widths):
        weights = parameters[start : start + units * inputs].reshape(units, inputs)
        value = np.tanh(value) if start else value
        value, start = weights @ value + parameters[start + units * inputs :][:units], start + units * (inputs + 1)
    return value


def play(seed: int) -> float:
    """The score of an episode."""
    environment: Any = gymnasium.make(about["task"].removeprefix("gym:"), **options.get("environment", {}))
    seen, space = environment.observation_space, environment.action_space
    observation, _ = environment.reset(seed=seed)
    score, over, steps = 0.0, False, 0
    while not over and steps < (environment.spec.max_episode_steps or 10_000):
        found = outputs(gymnasium.spaces.flatten(seen, observation))
        if isinstance(space, gymnasium.spaces.Discrete):
            action = np.int64(space.start + int(np.argmax(found)))
        else:
            low, high = np.float64(space.low), np.float64(space.high)
            action = np.tanh(found) * np.float32((high - low) / 2) + np.float32((high + low) / 2)
            action = np.clip(np.clip(action, np.float32(low), np.float32(high)), low, high)
            action = (np.rint(action) if np.issubdtype(space.dtype, np.integer) else action).astype(space.dtype)
        observation, reward, terminated, truncated, _ = environment.step(action)
        score, over, steps = score + float(reward), terminated or truncated, steps + 1
    environment.close()
    return score


if __name__ == "__main__":
    for word in sys.argv[1:] or ["10000"]:
        sys.stdout.write(f"{word} {play(int(word))}\n")
