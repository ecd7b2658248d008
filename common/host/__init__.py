"""The host and its processes: resource limits, signals, logs, streams, child processes, packages, users' modules.

Pages: platforms.md, unattended.md.
"""

__all__ = [
    "processes",
    "child",
    "parent_death",
    "process_pool",
    "stop_signals",
    "logs",
    "reports",
    "error_counter",
    "stall_watch",
    "resource_limits",
    "fingerprint",
    "packages",
    "add_ons",
    "user_code",
    "foreign_code",
    "trusted_modules",
    "standard_streams",
    "unseen_drawing",
]
