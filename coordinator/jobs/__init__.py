"""What a run scores: generations, evaluations, confirmations and kept rollouts, as jobs. Pure."""
