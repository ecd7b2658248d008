"""What CarRacing, the first world, computes: its drives, world models, trainings and dreams.

`python -m tests.support.first_world [PART ...]` writes these parts, or all, into `tests/fixtures/world_model.json`.
Do that only for a change that means to move them, and say in its message why they move.

Each part gives figures by what they depend on: `everywhere` is equal on every host, `simulator` on those with an equal
`fingerprint()`, and `torch` where torch's version is equal too.
"""

import hashlib
import io
import json
import os
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from safetensors import safe_open

from dreamfleet import find_bundle, find_controller
from dreamfleet.common.artifacts.bundle import MANIFEST, write_bundle
from dreamfleet.common.artifacts.car_racing_variants import CAR_RACING, Variant
from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES, fingerprint
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD, write_episode
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.training import train_mdnrnn, train_vae
from dreamfleet.worker.training.assemble import assemble, export_graphs, make_manifest
from dreamfleet.worker.training.checkpoint import load_weights
from dreamfleet.worker.training.data.collect import drive_episode
from dreamfleet.worker.training.data.collect_config import CollectConfig
from dreamfleet.worker.training.data.data_folder import store_preset
from dreamfleet.worker.training.data.dataset import episode_paths
from dreamfleet.worker.training.data.pilot import Pilot
from dreamfleet.worker.training.data.rollout_batches import done_labels, load_rollouts
from dreamfleet.worker.training.dream_facts import NO_DRIVES, describe_world
from dreamfleet.worker.training.encode import ENCODED, encode
from dreamfleet.worker.training.presets import PRESETS, TrainConfig
from dreamfleet.worker.training.torch_setup import on_one_thread
from dreamfleet.worker.worldmodel.mdnrnn import reward_labels
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import random_rnn_weights, random_vae_weights
from tests.support.drives import ignore, write_drive
from tests.support.variants import VARIANTS, vectors

GOLD = Path(__file__).parents[1] / "fixtures" / "world_model.json"
HOST = {"everywhere": "", "simulator": fingerprint(), "torch": fingerprint((*NUMERIC_PACKAGES, "torch"))}
SEED = 2**20 + 5  # of single episodes

STEPS = CollectConfig(steps=40, seed=5)
DRIVES = {
    **{f"random {number}": (STEPS, number) for number in range(3)},  # each of the three drivers
    **{name: (replace(STEPS, driver=name), 0) for name in ("uniform", "pushed", "network")},
    "whole": (replace(STEPS, picture=96), 3),
    "impatient": (replace(STEPS, anywhere=0.0, patience=5), 4),
}
FIRST_VARIANTS = {name: variant for name, variant in VARIANTS.items() if variant.actions != "linear"}  # a later one
SMALL_VAE = VAEConfig(latent=4, channels=(2, 2, 2, 2))
SMALL = MDNRNNConfig(latent=4, hidden=8, mixtures=2)
LAYERS = {
    "plain": SMALL,
    "ends": replace(SMALL, done=True, lost=2),
    "notebook": replace(SMALL, reward="notebook", previous_reward=True, first_reward=1.0, dropout=0.2),
    "value": replace(SMALL, reward="value"),
    "attentive": replace(SMALL, window=3),
}
SHORT = TrainConfig(updates=3, batch=8, rate=1e-3, validate_every=2)
COSTLY = {  # collected drives pay neither; within 120 steps a wheel leaves the road
    "costs": Variant(time_cost=0.5, offroad_cost=0.25)
}


def hashed(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def hashed_arrays(arrays):
    """Name, type, shape and hash of each array."""
    return {name: f"{array.dtype} {array.shape} {hashed(array.tobytes())}" for name, array in arrays.items()}


def hashed_scores(scores):
    return [f"{each.fitness.hex()} in {each.steps}" for each in scores]


def drives(_folder):
    """Random drives, those of the published sources, and one of a controller with noise and tried actions."""
    found = {name: drive_episode(*each) for name, each in DRIVES.items()}
    pilot = Pilot(find_controller("tiny"), find_bundle("tiny"))
    found["controller"] = drive_episode(replace(STEPS, spells=0.1), 0, (pilot,))
    files = {}
    for name, arrays in found.items():
        file = io.BytesIO()
        write_episode(file, arrays)
        with zipfile.ZipFile(file) as archive:  # the members, as hosts may compress them differently
            files[name] = {member: hashed(archive.read(member)) for member in archive.namelist()}
    texts = {name: [str(arrays["driver"]), str(arrays["preprocessing"])] for name, arrays in found.items()}
    return {
        "everywhere": {"arrays": {name: list(each) for name, each in files.items()}, "texts": texts},
        "simulator": files,
    }


def made_bundle(path, vae, rnn):
    """A world model of these layers, whose made-up weights no torch computed."""
    random = np.random.default_rng(3)

    def made(name, array):
        if not np.issubdtype(array.dtype, np.floating):
            return array
        low, high = (0.5, 1.5) if "running" in name else (-1.0, 1.0)
        return random.uniform(low, high, array.shape).astype(np.float32)

    drawn = random_vae_weights(vae=vae), random_rnn_weights(rnn=rnn)  # their names and shapes
    models = [{name: made(name, array) for name, array in sorted(each.items())} for each in drawn]
    initial = random.uniform(-1, 1, (4, 2, vae.latent)).astype(np.float32)
    parts = export_graphs(*models, initial, vae, rnn)
    facts = describe_world(OF_FIRST_WORLD, NO_DRIVES, rnn)
    return write_bundle(path, make_manifest("made", {"seed": 3}, facts, vae, rnn), parts)


def manifest_text(bundle):
    with zipfile.ZipFile(bundle.path) as archive:
        return archive.read(MANIFEST).decode()


def bundles(folder):
    """Graphs, manifest and file of world models with its presets' layers and with every kind of head."""
    own = {name: each for name, each in PRESETS.items() if each.task == CAR_RACING}
    layers = {name: (each.vae_layers, each.mdnrnn_layers) for name, each in own.items()}
    layers |= {f"small {name}": (SMALL_VAE, each) for name, each in LAYERS.items()}
    found = {name: made_bundle(folder / f"{name}.zip", *each) for name, each in layers.items()}
    return {
        "everywhere": {
            name: {"manifest": json.loads(manifest_text(each)), "file": each.sha256} for name, each in found.items()
        }
    }


def training_folder(folder):
    """A data set of made-up drives, of which some ended, encoded by a VAE after three updates."""
    store_preset(folder, "tiny", 0)
    for number in range(6):
        write_drive(folder, number, 14 - number % 3, ended=np.array(number % 2 == 0))
    train_vae.train_vae(folder, SHORT, ignore, SMALL_VAE)
    assert len(list(encode(folder))) == 6
    return folder


def trainings(folder):
    """Three updates of a VAE and of MDN-RNNs with every kind of head, what they learn from, and their bundles."""
    configs, computed, manifests = {}, {}, {}
    with on_one_thread():
        training_folder(folder)
        configs["vae"], computed["vae"] = checkpoint(folder / train_vae.CHECKPOINT)
        for name, layers in LAYERS.items():
            train_mdnrnn.train_mdnrnn(folder, SHORT, ignore, layers, new=True)
            configs[name], computed[name] = checkpoint(folder / train_mdnrnn.CHECKPOINT)
            bundle = assemble(folder, folder / f"{name}.zip", name, with_weights=False, recorded=9)
            manifests[name] = json.loads(manifest_text(bundle))
            computed[f"{name} bundle"] = manifests[name].pop("parts")
            del manifests[name]["provenance"]["versions"]
    paths = episode_paths(folder, ENCODED)
    batch = load_rollouts(paths, np.arange(len(paths)) % 2 == 1)
    given = {name: getattr(batch, name).numpy() for name in ("action", "reward", "done", "mask")}
    for name, layers in LAYERS.items():
        given[f"{name} done"] = done_labels(layers, batch).numpy()
        given[f"{name} reward"] = reward_labels(layers.reward, batch.reward, batch.done).numpy()
    with np.load(paths[0]) as encoded:
        computed["encoded"], names = hashed_arrays(encoded), encoded.files
    return {
        "everywhere": {
            "preset": (folder / "preset.json").read_text(),
            "configs": configs,
            "batch": hashed_arrays(given),
            "encoded": names,
            "manifests": manifests,
        },
        "torch": computed,
    }


def checkpoint(path):
    """The configuration as it is written, and the hashes of the weights."""
    with safe_open(path, "np") as file:
        return json.loads(file.metadata()["config"]), hashed_arrays(load_weights(path))


def dreams(folder):
    """Fitness and length of dreams of the world models that ship, of every variant, and with every kind of head."""
    tiny, able = find_bundle("tiny"), find_bundle("able")
    long, short = TaskSpec("dream", "", 200, 0, temperature=1.3), TaskSpec("dream", "", 30, 0, temperature=2.0)
    found = {
        "tiny": dreamt(tiny, long, 8),
        "able": dreamt(able, long, 8),
        "able, half from recorded states": dreamt(able, replace(long, recorded=0.5), 4),
    }
    found |= {name: dreamt(tiny.with_controllers(None, variant), short, 2) for name, variant in FIRST_VARIANTS.items()}
    found["hidden units"] = dreamt(tiny.with_controllers(tiny.shape_of("z", 4)), short, 2)
    for name, layers in LAYERS.items():
        found[f"small {name}"] = dreamt(made_bundle(folder / f"{name}.zip", SMALL_VAE, layers), short, 4)
    return {"simulator": found}


def dreamt(bundle, spec, count):
    spec = replace(spec, bundle=bundle.sha256)
    episodes = [(vector, SEED + number) for number, vector in enumerate(vectors(bundle, count))]
    return hashed_scores(DreamBatch(bundle, spec).score(episodes))


def episodes(_folder):
    """Scores and drives of controllers of every variant, as a worker computes them."""
    found, bundle = {}, find_bundle("tiny")
    for name, variant in {"plain": Variant(), **FIRST_VARIANTS, **COSTLY}.items():
        fitting = bundle.with_controllers(None, variant)
        shape, steps = fitting.controller_shape, 120 if name in COSTLY else 40
        spec = TaskSpec(
            "car-racing", bundle.sha256, steps, 0, None if shape == bundle.default_shape else shape,
            options=variant.options, version=variant.version,
        )  # fmt: skip
        scorer = Scorer(spec, bundle)
        (vector,) = vectors(fitting, 1)
        score, (plain, rollout) = scorer.score("score", vector, SEED), scorer.collect(vector, SEED)
        found[name] = [hashed_scores([score, plain]), hashed_arrays(rollout.arrays())]
        scorer.close()
    return {"simulator": found}


PARTS: dict[str, Callable[[Path], dict[str, dict]]] = {
    each.__name__: each for each in (drives, bundles, trainings, dreams, episodes)
}


def record(names):
    """Write these parts of the fixture, and leave the others as they are."""
    gold = json.loads(GOLD.read_text()) if GOLD.exists() else {}
    for name in names:
        with TemporaryDirectory() as folder:
            gold[name] = {kind: {"host": HOST[kind], "found": each} for kind, each in PARTS[name](Path(folder)).items()}
    GOLD.write_text(json.dumps(gold, indent=1) + "\n")


if __name__ == "__main__":
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    record(sys.argv[1:] or list(PARTS))
