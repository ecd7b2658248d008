"""Dreams on a torch device."""

__all__ = ["torch_batch"]
