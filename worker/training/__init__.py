"""From nothing to a bundle: collect, train the VAE, encode, train the MDN-RNN, bundle.

Pages: train.md, presets.md, own-world-model.md, files.md.
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
