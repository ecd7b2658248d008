"""A run's metrics for Prometheus."""

__all__ = ["metrics_server", "prometheus"]
