"""Everything that computes: tasks, world model, rollouts, training."""
