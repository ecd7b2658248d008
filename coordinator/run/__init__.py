"""One life of a run: ask the optimiser, hand out jobs, journal results, return scores to the optimiser."""
