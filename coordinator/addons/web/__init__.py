"""One small web server for add-ons: its address, limits, guard and streams of events."""

__all__ = ["server", "address", "documents", "guard"]
