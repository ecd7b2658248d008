"""A data set of made-up drives, written in milliseconds."""

from dataclasses import replace

import numpy as np

from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD
from dreamfleet.worker.training.data.dataset import episode_path, preprocessing_of_size


def write_drive(folder, number, steps=12, picture=64, world=OF_FIRST_WORLD, actions=3, **more):
    """One episode of noise under a moving bar, with a tile now and then; `more` are further arrays, or other ones."""
    random = np.random.default_rng(number)
    pictures = random.integers(0, 60, (steps, picture, picture, 3), dtype=np.uint8)
    for step in range(steps):
        pictures[step, :, (3 * step + number) % picture] = 255
    path = episode_path(folder, number)
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {
        "picture": pictures, "action": random.uniform(0, 1, (steps, actions)).astype(np.float32),
        "reward": np.where(np.arange(steps) % 3 == 0, 3.4, -0.1).astype(np.float32), "ended": np.array(False),
        "driver": np.array("held"), "preprocessing": np.array(preprocessing_of_size(picture, world).name),
    }  # fmt: skip
    named = {} if world == OF_FIRST_WORLD else {"world": np.array(world.text)}
    np.savez_compressed(path, **arrays | named | more)
    return path


def write_drives(folder, episodes=6, steps=12, picture=64):
    """So many episodes of unequal length."""
    return [write_drive(folder, number, steps - number % 3, picture) for number in range(episodes)]


def write_encoded_drives(folder):
    """A data set that an attentive MDN-RNN can learn from: its VAE is trained for two updates, and has encoded it."""
    from dreamfleet.worker.training.encode import encode
    from dreamfleet.worker.training.presets import TINY
    from dreamfleet.worker.training.train_vae import train_vae
    from dreamfleet.worker.worldmodel.vae_config import VAEConfig

    write_drives(folder)
    (folder / "preset.json").write_text('{"preset": "attentive"}')
    layers = VAEConfig(latent=4, channels=(2, 2, 2, 2))
    train_vae(folder, replace(TINY.vae, updates=2, batch=8, validate_every=1), lambda *_: None, layers)
    for _ in encode(folder):
        pass
    return folder


def ignore(*_):
    """Take no notice of a stage's progress."""
