"""One small web server for add-ons: its address, limits, guard and streams of events.

Pages: dashboard.md, ask-tell.md, threats.md.
"""

__all__ = ["server", "address", "documents", "guard"]
