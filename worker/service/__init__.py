"""The worker service: it joins a run, scores jobs, and delivers each result until it is acknowledged."""

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
