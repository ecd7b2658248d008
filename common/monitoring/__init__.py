"""The status of live runs: querying it, and views of it."""
