"""What controllers are measured against: random drivers, and a network that learns without a world model.

Its pages: docs/lab/baselines.md.
"""

__all__ = ["verb", "agents"]
