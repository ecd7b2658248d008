"""A run's numbers sent to other programs while it goes on."""
