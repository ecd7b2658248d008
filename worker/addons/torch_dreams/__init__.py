"""Dreams on a torch device. Pages: gpu.md, determinism.md, measurements.md."""

__all__ = ["torch_batch"]
