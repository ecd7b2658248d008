"""World models adjusted after their training: subspaces, refits."""
