"""The world model: frozen in ONNX Runtime for inference, as torch modules for training, and the export between them.

What `scoring` imports of it has no torch. Pages: determinism.md, worlds.md, import.md, train.md.
"""

import os

# ONNX Runtime reads it when it is first imported, which only modules of this package do. By default it would keep an
# identifier in the user's cache folder, and report each process to its maker.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__all__ = [
    "vae_config",
    "vae",
    "mdnrnn_config",
    "mdnrnn",
    "inference",
    "policy",
    "recurrent_state",
    "choice_memory",
    "observation",
    "export",
    "mdnrnn_graph",
    "onnx_graph",
    "eight_bits",
]
