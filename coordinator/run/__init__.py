"""One incarnation of a run: ask the optimiser, hand out jobs, journal results, return scores to the optimiser.

Its pages: docs/reference/protocol.md, docs/how-to/stop-and-resume.md, docs/how-to/trust.md, docs/how-to/stages.md.
"""

__all__ = ["run", "run_state", "worker_protocol", "batches", "recall", "report", "shown_state"]
