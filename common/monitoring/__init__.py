"""The status of a live run: asking for it, and views of it."""
