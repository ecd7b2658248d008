"""Which worker gets which job: leases, credit, lost workers, speculative copies. Pure.

Its pages: docs/reference/protocol.md, docs/explanation/decisions.md, docs/how-to/unattended.md.
"""

__all__ = ["fleet", "member", "pending_jobs", "packing", "host_stats", "failures", "refusals", "event_log"]
