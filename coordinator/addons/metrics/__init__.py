"""A run's metrics for Prometheus. Pages: metrics.md, monitor.md."""

__all__ = ["metrics_server", "prometheus"]
