"""Which worker gets which job: leases, credit, lost workers, speculative copies. Pure."""
