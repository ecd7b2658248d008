"""A run's status on a terminal."""
