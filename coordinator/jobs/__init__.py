"""What is to be scored: generations, evaluations, confirmations, collected rollouts. Pure."""
