"""One incarnation of a run: ask the optimiser, hand out jobs, journal results, return scores to the optimiser."""

__all__ = ["run", "run_state", "worker_protocol", "batches", "recall", "report", "shown_state"]
