"""One small web server for add-ons: its address, limits, guard and streams of events."""
