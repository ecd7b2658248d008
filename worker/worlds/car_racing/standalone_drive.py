"""Drive CarRacing-v3 by `controller.onnx` beside this file: `python drive.py 10000` prints the score of that seed.

pip install 'gymnasium[box2d]' onnxruntime numpy
"""

import os
import sys
from pathlib import Path

import gymnasium
import numpy as np

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # read when ONNX Runtime is imported; else it reports to its maker
import onnxruntime

options = onnxruntime.SessionOptions()
options.intra_op_num_threads = options.inter_op_num_threads = 1
FILE = Path(__file__).with_name("controller.onnx")
controller = onnxruntime.InferenceSession(FILE, options, providers=["CPUExecutionProvider"])
sizes = {each.name: each.shape for each in controller.get_inputs()}


def shrink(observation: np.ndarray) -> np.ndarray:
    """Rows 0 to 83 of an observation (96, 96, 3), averaged exactly over boxes of 21/16 x 3/2 pixels: (64, 64, 3)."""
    first, row = 21 * np.arange(64)[:, None], 16 * np.arange(84)
    weights = np.clip(np.minimum(first + 21, row + 16) - np.maximum(first, row), 0, 16)  # sixteenths of a row
    left, middle, right = np.moveaxis((weights @ observation[:84].reshape(84, -1)).reshape(64, 32, 3, 3), 2, 0)
    return ((np.stack([2 * left + middle, 2 * right + middle], 2) + 31) // 63).astype(np.uint8).reshape(64, 64, 3)


def drive(seed: int) -> float:
    """The score of an episode of 1,000 steps at most."""
    environment = gymnasium.make("CarRacing-v3")
    observation, _ = environment.reset(seed=seed)
    state, score, over = np.zeros((1, sizes["state"][1]), np.float32), 0.0, False
    while not over:
        picture = observation if sizes["picture"][1] == len(observation) else shrink(observation)
        action, state = controller.run(["action", "next_state"], {"picture": picture[None], "state": state})
        observation, reward, terminated, truncated, _ = environment.step(action[0])
        score, over = score + float(reward), terminated or truncated
    environment.close()
    return score


if __name__ == "__main__":
    for word in sys.argv[1:] or ["10000"]:
        sys.stdout.write(f"{word} {drive(int(word))}\n")
