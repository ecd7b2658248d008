"""Controllers fitted to another world model by recorded drives, and subspaces of parameters for a search.

Its pages: docs/how-to/rounds.md, docs/reference/files.md.
"""

__all__ = ["refit_verb", "subspace_verb", "stages"]
