"""The host and its processes: limits, signals, logs, streams, parent death."""
