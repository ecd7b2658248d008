"""A run's metrics for Prometheus.

Its pages: docs/reference/metrics.md, docs/how-to/monitor.md.
"""

__all__ = ["metrics_server", "prometheus"]
