"""Several verbs in sequence: the demonstration, iteration, contrast."""
