"""Dreams on a torch device. Pages: gpu.md, determinism.md."""

__all__ = ["torch_batch"]
