"""Which worker gets which job: leases, credit, losses, speculative copies. Pure."""
