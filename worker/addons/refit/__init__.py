"""Controllers fitted to another world model by recorded drives, and subspaces of parameters for a search.

Pages: rounds.md, files.md, dreams-notes.md.
"""

__all__ = ["refit_verb", "subspace_verb", "stages"]
