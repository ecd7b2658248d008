"""Tasks: the contract between an environment, a policy and the rest of the system, and finding tasks by name."""
