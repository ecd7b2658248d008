"""World models adjusted after their training: subspaces, refits."""

__all__ = ["refit_verb", "refit_stage", "subspace_verb", "subspace_stage"]
