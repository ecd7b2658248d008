"""One small web server for add-ons: its address, limits, guard and streams of events.

Its pages: docs/how-to/dashboard.md, docs/how-to/ask-tell.md, docs/explanation/threats.md.
"""

__all__ = ["server", "address", "documents", "guard"]
