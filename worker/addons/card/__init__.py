"""A controller as a folder to publish."""
