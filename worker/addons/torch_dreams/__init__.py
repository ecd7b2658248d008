"""Dreams on a torch device.

Its pages: docs/how-to/gpu.md, docs/explanation/determinism.md.
"""

__all__ = ["torch_batch"]
