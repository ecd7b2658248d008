"""A data set of made-up drives, written in milliseconds."""

from dataclasses import replace

import numpy as np

from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD
from dreamfleet.worker.training.data.dataset import episode_path, preprocessing_of_size


def write_drive(folder, number, steps=12, picture=64, world=OF_FIRST_WORLD, actions=3, pictures=None, **more):
    """One episode of noise under a moving bar, with a tile now and then; `more` are further arrays, or other ones.

    `pictures` are shown instead of the noise.
    """
    random = np.random.default_rng(number)
    noise = random.integers(0, 60, (steps, picture, picture, 3), dtype=np.uint8)
    for step in range(steps):
        noise[step, :, (3 * step + number) % picture] = 255
    path = episode_path(folder, number)
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {
        "picture": noise if pictures is None else pictures,
        "action": random.uniform(0, 1, (steps, actions)).astype(np.float32),
        "reward": np.where(np.arange(steps) % 3 == 0, 3.4, -0.1).astype(np.float32),
        "ended": np.array(False),
        "driver": np.array("held"),
        "preprocessing": np.array(preprocessing_of_size(picture, world).name),
        "world": np.array(world.text),
    }
    np.savez_compressed(path, **arrays | more)
    return path


def grey(brightness, side=64):
    """Plain pictures `(T, side, side, 3)` of this brightness `(T,)`."""
    return np.tile(brightness.astype(np.uint8)[:, None, None, None], (1, side, side, 3))


def write_drives(folder, episodes=6, steps=12, picture=64):
    """So many episodes of unequal length; their paths."""
    return [write_drive(folder, number, steps - number % 3, picture) for number in range(episodes)]


def write_encoded(folder, rewards, latent=4, actions=3, *, ended=False):
    """Encoded drives of zeros with these rewards `(episodes, T)`; `ended`: each ends at its last step."""
    (folder / "encoded").mkdir(parents=True)
    paths = [folder / "encoded" / f"{number:06d}.npz" for number in range(len(rewards))]
    for path, reward in zip(paths, np.asarray(rewards, np.float32), strict=True):
        rows = {"mu": latent, "logvar": latent, "action": actions}
        zeros = {name: np.zeros((len(reward), size), np.float32) for name, size in rows.items()}
        np.savez(path, **zeros, reward=reward, ended=np.array(ended), world=np.array(OF_FIRST_WORLD.text))
    return paths


def train_models(folder, config, eyes, memory=None):
    """Train a VAE on a folder's drives, encode these, and, if its layers are given, train an MDN-RNN."""
    from dreamfleet.worker.training.encode import encode
    from dreamfleet.worker.training.train_mdnrnn import train_mdnrnn
    from dreamfleet.worker.training.train_vae import train_vae

    train_vae(folder, config, ignore, eyes)
    list(encode(folder))
    if memory is not None:
        train_mdnrnn(folder, config, ignore, memory)
    return folder


def write_encoded_drives(folder):
    """A data set that an attentive MDN-RNN can learn from: its VAE is trained for two updates, and has encoded it."""
    from dreamfleet.worker.training.presets import TINY
    from dreamfleet.worker.worldmodel.vae_config import VAEConfig

    write_drives(folder)
    (folder / "preset.json").write_text('{"preset": "attentive", "task": "car-racing"}')
    config = replace(TINY.vae, updates=2, batch=8, validate_every=1)
    return train_models(folder, config, VAEConfig(latent=4, channels=(2, 2, 2, 2)))


def linked(source, folder, *names):
    """A folder in which these files or folders of another one are links."""
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / name).symlink_to(source / name)
    return folder


def ignore(*_):
    """Take no notice of a stage's progress."""
