"""Which worker gets which job: leases, credit, lost workers, failed jobs, refusals, speculative copies. Pure.

Pages: protocol.md, decisions.md, unattended.md, status.md, troubleshooting.md, measurements.md.
"""

__all__ = ["fleet", "member", "pending_jobs", "packing", "host_stats", "failures", "refusals", "event_log"]
