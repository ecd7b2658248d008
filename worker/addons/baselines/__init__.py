"""What controllers are measured against: random drivers, and a network that learns without a world model.

Pages: baselines.md.
"""

__all__ = ["verb", "agents"]
