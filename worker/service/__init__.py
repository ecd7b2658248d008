"""The worker service: it joins a run, scores jobs, and delivers each result until it is acknowledged.

Its pages: docs/reference/protocol.md, docs/how-to/hosts.md, docs/how-to/unattended.md, docs/how-to/mixed-hosts.md.
"""

__all__ = [
    "worker",
    "config",
    "admission",
    "bundle_fetch",
    "backlog",
    "outbox",
    "slot",
    "child",
    "job_group",
    "frame_sampler",
    "frame_publisher",
]
