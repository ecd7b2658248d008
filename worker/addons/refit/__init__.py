"""World models adjusted after their training: subspaces, refits."""

__all__ = ["refit_verb", "subspace_verb", "stages"]
