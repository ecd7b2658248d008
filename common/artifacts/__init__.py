"""Files that a run reads and writes: bundles, controllers, agents, subspaces."""
