"""From nothing to a bundle: collect, train the VAE, encode, train the MDN-RNN, bundle.

Its pages: docs/how-to/train.md, docs/reference/presets.md, docs/tutorials/own-world-model.md.
"""

__all__ = [
    "presets",
    "config_flags",
    "train_vae",
    "encode",
    "train_mdnrnn",
    "training_state",
    "checkpoint",
    "assemble",
    "torch_setup",
    "dream_facts",
]
