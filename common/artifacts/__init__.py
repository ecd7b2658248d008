"""What a run makes and needs as files: bundles, controllers, agents, subspaces."""
