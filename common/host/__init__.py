"""The host and its processes: resource limits, signals, logs, streams, child processes."""
