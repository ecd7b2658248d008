"""Many kinds of behaviour: optimisers that keep an archive, and its picture.

Its pages: docs/how-to/quality-diversity.md, docs/reference/optimisers.md.
"""

__all__ = ["archive_plot", "optimisers"]
