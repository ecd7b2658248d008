"""The worker service: it joins a run, scores jobs, and delivers each result until it is acknowledged.

Slots are shared by runs, and live frames go to viewers. Pages: protocol.md, hosts.md, unattended.md, mixed-hosts.md.
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
