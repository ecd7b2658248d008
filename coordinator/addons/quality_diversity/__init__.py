"""Many kinds of behaviour: optimisers that keep an archive, and its picture."""

__all__ = ["archive_plot", "optimisers"]
