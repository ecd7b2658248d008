"""One incarnation of a run: ask the optimiser, hand out jobs, journal results, return scores to the optimiser.

Also who may join, batches of others, checks and recalls. Pages: protocol.md, stop-and-resume.md, trust.md, stages.md.
"""

__all__ = ["run", "run_state", "worker_protocol", "batches", "recall", "report", "shown_state"]
