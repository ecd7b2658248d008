"""Many kinds of behaviour: optimisers that keep an archive, and its picture.

Pages: quality-diversity.md, optimisers.md.
"""

__all__ = ["archive_plot", "optimisers"]
